"""From plain configuration to objects: ``_target_`` names a class, the other keys are its arguments.

Hydra composes the yaml; this builds it, because a checkpoint carries its configuration too, and what comes out of
a file must not be able to name arbitrary callables or read the environment through interpolations.
"""

import difflib
import functools
import importlib
import inspect
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from omegaconf import OmegaConf

from ghpt.errors import GhptConfigError

TRUSTED = ("ghpt", "torch.optim", "torch.nn")
"""The packages whose classes a checkpoint may name."""


def plain(config: Any) -> Any:
    """Resolve an OmegaConf node to dicts, lists and scalars."""
    return OmegaConf.to_container(config, resolve=True, throw_on_missing=True)


def suggest(word: str, existing: Iterable[object]) -> str:
    """One sentence that says what exists, the nearest name first where there is one."""
    names = sorted(map(str, existing))
    near = difflib.get_close_matches(word, names, n=1)
    return (f"Did you mean {near[0]!r}? " if near else "") + f"Existing: {', '.join(names) or 'none'}."


def build(config: Any, path: str = "config", packages: Sequence[str] | None = None) -> Any:
    """Build what a plain configuration describes, inner parts first.

    ``packages`` limits what ``_target_`` may name to objects defined in these packages (None: any).
    ``_partial_: true`` gives the class with these arguments bound, not yet called.
    Raises GhptConfigError, naming the key's path, for an unknown target or argument or a missing argument.
    """
    if isinstance(config, Mapping):
        values = {k: build(v, f"{path}.{k}", packages) for k, v in config.items() if k not in ("_target_", "_partial_")}
        if "_target_" not in config:
            return values
        target = _locate(config["_target_"], path, packages)
        _check_arguments(target, values, path, partial=bool(config.get("_partial_")))
        return functools.partial(target, **values) if config.get("_partial_") else target(**values)
    if isinstance(config, list | tuple):
        return [build(v, f"{path}[{i}]", packages) for i, v in enumerate(config)]
    return config


def _locate(target: Any, path: str, packages: Sequence[str] | None) -> Any:
    key = f"{path}._target_"
    parts = str(target).split(".")
    if packages is not None and not any(str(target).startswith(f"{p}.") for p in packages):
        raise GhptConfigError(key, f"{target!r} is outside {', '.join(packages)}", "Name a class of these packages.")
    try:
        module, found = next(
            (importlib.import_module(".".join(parts[:n])), n)
            for n in range(len(parts) - 1, 0, -1)
            if _is_module(".".join(parts[:n]))
        )
        for name in parts[found:]:
            module = getattr(module, name)
    except (StopIteration, AttributeError):
        raise GhptConfigError(key, f"no class {target!r}", "Check the spelling of the full name.") from None
    # An alias such as ghpt.files.os.system must not pass for one of ours.
    home = getattr(module, "__module__", None) or ""
    if not callable(module) or (
        packages is not None and not any(home == p or home.startswith(f"{p}.") for p in packages)
    ):
        raise GhptConfigError(key, f"{target!r} is not a class of ours", "Name a class of this project.")
    return module


def _is_module(name: str) -> bool:
    try:
        importlib.import_module(name)
    except ImportError as error:
        if error.name is not None and (name == error.name or name.startswith(f"{error.name}.")):
            return False
        raise
    return True


def _check_arguments(target: Any, values: Mapping[str, Any], path: str, partial: bool) -> None:
    try:
        parameters = inspect.signature(target).parameters.values()
    except ValueError:
        return
    named = [p for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    if not any(p.kind is p.VAR_KEYWORD for p in parameters):
        for key in set(values) - {p.name for p in named}:
            mend = suggest(key, (p.name for p in named))
            raise GhptConfigError(f"{path}.{key}", f"{target.__qualname__} has no such setting", mend)
    missing = [p.name for p in named if p.default is p.empty and p.name not in values]
    if missing and not partial:
        raise GhptConfigError(path, f"{target.__qualname__} needs {', '.join(missing)}", "Set it in the yaml.")
