"""From plain configuration to objects: ``_target_`` names a class, the other keys are its arguments.

Hydra composes the yaml; this builds it, because a checkpoint carries its configuration too, and what comes out of
a file must not be able to name arbitrary callables or read the environment through interpolations.
"""

import difflib
import functools
import importlib
import inspect
import math
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints, is_typeddict

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
    Raises GhptConfigError, naming the key's path, for an unknown target or argument, a missing argument, and a value
    that is not of its parameter's type.
    """
    if isinstance(config, Mapping):
        values = {k: build(v, f"{path}.{k}", packages) for k, v in config.items() if k not in ("_target_", "_partial_")}
        if "_target_" not in config:
            return values
        target = _locate(config["_target_"], path, packages)
        partial = bool(config.get("_partial_"))
        check_arguments(target, values, path, partial)
        if partial:
            return functools.partial(target, **values)
        try:
            return target(**values)
        except GhptConfigError as error:
            if error.key not in values:
                raise
            raise GhptConfigError(f"{path}.{error.key}", error.problem, error.mend) from error
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


def check_arguments(target: Any, values: Mapping[str, Any], path: str, partial: bool = False) -> None:
    """Raise GhptConfigError unless ``target(**values)`` has its arguments, by name and by annotated type.

    ``partial``: more may come later. ``path`` is the key that the values stand under.
    """
    parameters, open_ended = _parameters(target)
    for key, value in values.items():
        if key in parameters:
            check_type(value, parameters[key][0], f"{path}.{key}")
        elif not open_ended:
            raise GhptConfigError(
                f"{path}.{key}", f"{target.__qualname__} has no such setting", suggest(key, parameters)
            )
    missing = [name for name, (_, required) in parameters.items() if required and name not in values]
    if missing and not partial:
        raise GhptConfigError(path, f"{target.__qualname__} needs {', '.join(missing)}", "Set it in the yaml.")


def check_type(value: Any, wanted: Any, key: str) -> None:
    """Raise GhptConfigError unless a plain value is what the annotation ``wanted`` says; an integer is a number too."""
    if is_typeddict(wanted) and isinstance(value, Mapping):
        for name, inner in get_type_hints(wanted).items():
            if name not in value:
                if name in wanted.__optional_keys__:
                    continue
                raise GhptConfigError(f"{key}.{name}".lstrip("."), "is missing", "Set it in the yaml.")
            check_type(value[name], inner, f"{key}.{name}".lstrip("."))
    elif not _fits(value, wanted):
        shown = "null" if value is None else repr(value)
        raise GhptConfigError(key, f"is {shown}, not {_words(wanted)}", "Give a value of this kind.")


def _parameters(target: Any) -> tuple[dict[str, tuple[Any, bool]], bool]:
    """Name -> (annotation, required), with what ``**settings`` hands on to parent classes; whether any name goes."""
    found: dict[str, tuple[Any, bool]] = {}
    own = int(inspect.isclass(target))  # self is no setting
    for function in [vars(c)["__init__"] for c in target.__mro__ if "__init__" in vars(c)] if own else [target]:
        try:
            signature = inspect.signature(function).parameters.values()
        except ValueError:  # of C, without a signature
            return found, True
        try:
            hints = get_type_hints(function)
        except (NameError, TypeError):  # names that exist for type checkers alone
            hints = {}
        for p in list(signature)[own:]:
            if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY):
                found.setdefault(p.name, (hints.get(p.name, Any), p.default is p.empty))
        if not any(p.kind is p.VAR_KEYWORD for p in signature):
            return found, False
    return found, True


_SCALARS = {int: "an integer", float: "a finite number", bool: "true or false", str: "text", types.NoneType: "null"}


def _fits(value: Any, wanted: Any) -> bool:
    origin, inner = get_origin(wanted), get_args(wanted)
    if origin in (Union, types.UnionType):
        return any(_fits(value, one) for one in inner)
    if origin is Literal:
        return value in inner
    if wanted is float:
        return type(value) in (int, float) and math.isfinite(value)
    if wanted in _SCALARS:
        return type(value) is wanted  # true is no integer
    if origin is Callable:
        return callable(value)
    if origin in (list, tuple, Sequence, Iterable):
        return isinstance(value, list | tuple) and (len(inner) != 1 or all(_fits(one, inner[0]) for one in value))
    if origin in (dict, Mapping) or is_typeddict(wanted):
        return isinstance(value, Mapping)
    return not isinstance(wanted, type) or wanted is object or type(value) not in _SCALARS


def _words(wanted: Any) -> str:
    """What ``_fits`` looks for, for people."""
    origin, inner = get_origin(wanted), get_args(wanted)
    if origin in (Union, types.UnionType):
        plain_ones = [one for one in inner if one in _SCALARS or get_origin(one) is Literal]
        return " or ".join(dict.fromkeys(map(_words, plain_ones or inner)))
    if origin is Literal:
        return ("one of " if len(inner) > 1 else "") + ", ".join(map(repr, inner))
    if origin in (list, tuple, Sequence, Iterable):
        return "a list" + (f" ({_words(inner[0])} each)" if inner else "")
    if origin in (dict, Mapping) or is_typeddict(wanted):
        return "a group of settings"
    return _SCALARS.get(wanted) or f"a {getattr(wanted, '__name__', wanted)}: a group of settings with _target_"
