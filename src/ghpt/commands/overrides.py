"""The words of a command line, checked before Hydra composes them: a mistake is named, with what
exists.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import OmegaConf

from ghpt.config import suggest
from ghpt.errors import GhptConfigError


def check_overrides(conf: Path, config_name: str, words: Sequence[str]) -> list[Override]:
    """The parsed overrides. Raises GhptConfigError, saying what exists, for a setting or a choice
    that does not.
    """
    overrides = [_parse(word) for word in words]
    groups = {}
    for override in overrides:
        if (conf / override.key_or_group).is_dir() and not override.is_delete():
            chosen = [
                _check_choice(conf, override.key_or_group, value) for value in _values(override)
            ]
            groups[override.key_or_group] = f"{override.get_key_element()}={chosen[0]}"
    with hydra.initialize_config_dir(str(conf), version_base="1.3"):
        config: Any = OmegaConf.to_container(
            hydra.compose(config_name, overrides=list(groups.values()))
        )
    for override in overrides:
        key = override.key_or_group
        if (
            key not in groups
            and not key.startswith("hydra")
            and "@" not in key
            and not (conf / key).is_dir()
        ):
            _check_key(config, key, added=override.is_add() or override.is_force_add())
    return overrides


def _parse(word: str) -> Override:
    try:
        return OverridesParser.create().parse_override(word)
    except HydraException:
        hint = "Such as data=cmu2 or 'data.cameras=[1,2]'; --help shows all settings."
        raise GhptConfigError(word, "is not of the form key=value", hint) from None


def _values(override: Override) -> list[Any]:
    """The values that a sweep takes in turn, or the only one."""
    value = override.value()
    return list(override.sweep_string_iterator()) if override.is_sweep_override() else [value]


def _check_choice(conf: Path, group: str, value: Any) -> Any:
    existing = sorted(path.stem for path in (conf / group).glob("[!_]*.yaml"))
    for name in value if isinstance(value, list) else [value]:
        if name not in existing:
            shown = "null" if name is None else repr(name)
            raise GhptConfigError(group, f"there is no {shown}", suggest(str(name), existing))
    return value if not isinstance(value, list) else f"[{','.join(map(str, value))}]"


def _check_key(config: dict[str, Any], key: str, added: bool) -> None:
    node: Any = config
    parts = key.split(".")
    for depth, part in enumerate(parts):
        if not isinstance(node, dict) or part not in node:
            if added and depth:
                return  # whatever is built from it knows its settings
            above = ".".join(parts[:depth])
            hint = suggest(part, node if isinstance(node, dict) else [])
            elsewhere = [path for path in _paths(config) if path.endswith(f".{parts[-1]}")]
            if elsewhere and "Did you mean" not in hint:
                hint = f"Did you mean {elsewhere[0]!r}? {hint}"
            raise GhptConfigError(key, f"no such setting{f' in {above}' if above else ''}", hint)
        node = node[part]


def _paths(node: dict[str, Any], above: str = "") -> Iterator[str]:
    for key, value in node.items():
        yield f"{above}{key}"
        if isinstance(value, dict):
            yield from _paths(value, f"{above}{key}.")
