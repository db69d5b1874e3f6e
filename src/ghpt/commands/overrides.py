"""The words of a command line, checked before Hydra composes them.

A mistake is named, with what exists, before anything heavy is imported.
"""

import argparse
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import OmegaConf

from ghpt.commands.display import shell_override, slash_path
from ghpt.config import suggest
from ghpt.errors import GhptConfigError

_SEARCH_PATH = "hydra.searchpath"
_SWEEP = {"-m", "--multirun"}
_FORMER_NAMES = {
    "doctor": "camera_check",
    "swaps": "flips",
    "triangulation": "estimator",
    "estimator.classical": "predictor.classical",
    "estimator.learned": "predictor.learned",
    "model.scheduler": "model.schedule",
    "model.spread": "model.logit_std_cap",
}
"""Settings by the names that scripts for earlier versions, or others of their kind, give."""
_GONE = {
    "view_weights": "Leave it out: estimator=frame_learned does better, and ckpt= is the paper's "
    "estimate."
}
"""What stands in for settings of earlier versions that no longer exist."""


@dataclass(frozen=True)
class Source:
    """Where a command's configuration comes from."""

    folder: Path
    """The folder of the yaml files."""
    name: str
    """The name of the first of them, without .yaml."""
    more: Path | None = None
    """A folder of a user's own files, which go before those in ``folder``."""


def compose(source: Source, words: Sequence[str], with_hydra: bool = False) -> Any:
    """Return the DictConfig that the words of a command line make of the yaml files."""
    overrides = [_parse(word) for word in words]
    with ExitStack() as stack:
        # Under a command Hydra is initialised already, with the folder of that command.
        if not GlobalHydra.instance().is_initialized():
            folder = hydra.initialize_config_dir(str(source.folder), version_base="1.3")
            stack.enter_context(folder)
        search_path = _search_path(source, overrides)
        return hydra.compose(
            source.name, overrides=[*words, *search_path], return_hydra_config=with_hydra
        )


def check_choices(source: Source, words: Sequence[str]) -> list[Override]:
    """Return the parsed overrides of a command line that is no sweep's.

    Raises GhptConfigError, saying what exists, for a choice of a group that does not, and for
    several values of a setting.
    """
    overrides = _parse_all(words, sweep=False)
    with hydra.initialize_config_dir(str(source.folder), version_base="1.3"):
        _chosen_groups(source, overrides)
    return overrides


def check_overrides(source: Source, words: Sequence[str], sweep: bool = True) -> list[Override]:
    """Return the parsed overrides of a command line.

    Raises GhptConfigError, saying what exists, for a setting or a choice that does not, and for
    several values of one where ``sweep`` is false.
    """
    overrides = _parse_all(words, sweep)
    with hydra.initialize_config_dir(str(source.folder), version_base="1.3"):
        groups = _chosen_groups(source, overrides)
        chosen = [*_search_path(source, overrides), *groups.values()]
        composed = hydra.compose(source.name, overrides=chosen)
    config = OmegaConf.to_container(composed)
    for override in overrides:
        key = override.key_or_group
        is_hydras = key.startswith("hydra") or "@" in key
        is_group = key in groups or (source.folder / key).is_dir()
        if not is_hydras and not is_group:
            added = override.is_add() or override.is_force_add()
            _check_key(config, key, added)
    return overrides


def spread_seeds(words: Sequence[str]) -> list[str]:
    """Return the words of ``reproduce``; in a sweep ``seeds=5`` becomes ``seed=0,1,2,3,4``.

    Every seed is then a job.
    """
    values = dict(word.split("=", 1) for word in words if "=" in word)
    count = values.get("seeds", "")
    first = values.get("seed", "0")
    are_numbers = count.isdecimal() and first.isdecimal()
    if not _SWEEP & set(words) or not are_numbers or int(count) <= 1:
        return list(words)
    seeds = range(int(first), int(first) + int(count))
    others = [word for word in words if not word.startswith(("seeds=", "seed="))]
    return [*others, "seed=" + ",".join(map(str, seeds))]


def rename_settings(words: Sequence[str]) -> list[str]:
    """Return the words of a command line with today's names of settings.

    Raises GhptConfigError for settings that are gone.
    """
    renamed = []
    for word in words:
        key, equals, value = word.partition("=")
        group = key.lstrip("+~").split(".")[0]
        if equals and group in _GONE:
            raise GhptConfigError(key, "is gone", _GONE[group])
        for former, name in _FORMER_NAMES.items():
            if equals and (key == former or key.startswith(f"{former}.")):
                key = name + key.removeprefix(former)
        renamed.append(f"{key}{equals}{value}")
    return renamed


def expand_home(words: Sequence[str]) -> list[str]:
    """Return the words of a command line, with the user's folder for the ~ of a value."""
    expanded = []
    for word in words:
        key, equals, value = word.partition("=")
        is_home = equals and re.match(r"~(/|\\|$)", value)
        expanded.append(f"{key}={Path(value).expanduser()}" if is_home else word)
    return expanded


def use_slashes(words: Sequence[str]) -> list[str]:
    """Return the words of a command line, with slashes in the paths of Windows."""
    changed = []
    for word in words:
        key, equals, value = word.partition("=")
        changed.append(f"{key}{equals}{slash_path(value)}")
    return changed


def flags_first(words: Sequence[str]) -> list[str]:
    """Return the words with ``-m`` ahead: Hydra takes no setting that stands behind an option."""
    flags = [word for word in words if word in _SWEEP]
    return [*flags, *(word for word in words if word not in _SWEEP)]


def parse_options(parser: argparse.ArgumentParser, words: Sequence[str]) -> argparse.Namespace:
    """Return the options of a command line, which may stand between settings.

    Raises GhptConfigError for one that Hydra does not have: a setting with dashes before it.
    """
    arguments, unknown = parser.parse_known_intermixed_args(words)
    for word in unknown:
        name, _, value = word.lstrip("-").partition("=")
        if not word.startswith("-"):
            hint = f"Put the options that begin with dashes before the settings: ... {word}"
            raise GhptConfigError(word, "stands behind an option", hint)
        following = [*words[list(words).index(word) + 1 :], "..."][0]
        hint = f"Settings have no dashes: {name}={value or following}. --help shows all."
        raise GhptConfigError(word, "is no option", hint)
    return arguments


def _parse_all(words: Sequence[str], sweep: bool) -> list[Override]:
    overrides = [_parse(word) for word in words]
    if not sweep:
        for override in overrides:
            _check_single(override)
    return overrides


def put_options_first(words: Sequence[str], overrides: Sequence[str]) -> list[str]:
    """Return a command line whose settings stand behind its options, as Hydra wants them."""
    options = list(words)
    for override in overrides:
        options.remove(override)
    return [*options, *overrides]


def _check_single(override: Override) -> None:
    """Raise GhptConfigError for several values, which only a sweep takes in turn."""
    key = override.get_key_element()
    if not override.is_sweep_override() or key.startswith("hydra"):
        return
    text = str(override.input_line).partition("=")[2]
    hint = f"For a list, write '{key}=[{text}]'; to run with each in turn, add -m."
    if re.fullmatch(r"-?\d+,\d+", text):
        hint = f"A number has a point: {key}={text.replace(',', '.')}. {hint}"
    raise GhptConfigError(key, f"has several values ({text})", hint)


def _parse(word: str) -> Override:
    try:
        return OverridesParser.create().parse_override(word)
    except HydraException:
        key, equals, value = word.partition("=")
        hint = "Such as data=cmu2 or 'data.cameras=[1,2]'; --help shows all settings."
        if equals and value.count("[") != value.count("]"):
            hint = f"Write a list without spaces: {key}=[first,second]."
        elif equals:
            hint = f"Quote the value: {shell_override(key, value)}."
        elif re.fullmatch(r"[A-Za-z_.]+", word):
            hint = f"Write {word}=VALUE. {hint}"
        raise GhptConfigError(word, "is not of the form key=value", hint) from None


def _search_path(source: Source, overrides: Sequence[Override]) -> list[str]:
    """Return the override by which Hydra finds a user's own files too, if there are any."""
    places: list[str] = []
    for override in overrides:
        value = override.value()
        if override.get_key_element() == _SEARCH_PATH and isinstance(value, list):
            places = [str(place) for place in value]
    if source.more is not None:
        places.append(f"file://{source.more}")
    quoted = ",".join(f"'{place}'" for place in places)
    return [f"{_SEARCH_PATH}=[{quoted}]"] if places else []


def _chosen_groups(source: Source, overrides: Sequence[Override]) -> dict[str, str]:
    """Return the first choice of each group that the command line names, within Hydra's block.

    Raises GhptConfigError for a choice that does not exist.
    """
    loader = GlobalHydra.instance().config_loader()
    search_path = _search_path(source, overrides)
    groups = {}
    for override in overrides:
        group = override.key_or_group
        choices = _choices(loader, source, group, search_path)
        if choices and not override.is_delete():
            groups[group] = _first_choice(override, choices)
    return groups


def _choices(loader: ConfigLoader, source: Source, group: str, search_path: list[str]) -> list[str]:
    """Return what a group of the configuration offers; nothing for what is no group of ours."""
    is_ours = (source.folder / group).is_dir() or search_path or _names_more_folders(source)
    if not is_ours or group.startswith("hydra/"):  # to ask Hydra costs as much as to read a file
        return []
    names = loader.get_group_options(group, config_name=source.name, overrides=search_path)
    return sorted(name for name in names if not name.startswith("_"))


def _names_more_folders(source: Source) -> bool:
    """Return whether the first yaml file itself says where else groups are."""
    first = source.folder / f"{source.name}.yaml"
    return first.is_file() and "searchpath" in first.read_text(encoding="utf-8")


def _values(override: Override) -> list[Any]:
    """Return the values that a sweep takes in turn, or the only one."""
    if override.is_sweep_override():
        return list(override.sweep_string_iterator())
    return [override.value()]


def _first_choice(override: Override, existing: Sequence[str]) -> str:
    """Return the override with the first of its values.

    Raises GhptConfigError if one of them is no choice of the group.
    """
    values = _values(override)
    for value in values:
        names = value if isinstance(value, list) else [value]
        for name in names:
            _check_choice(override.key_or_group, name, existing)
    first = values[0]
    if isinstance(first, list):
        names = [str(name) for name in first]
        first = f"[{','.join(names)}]"
    return f"{override.get_key_element()}={first}"


def _check_choice(group: str, name: Any, existing: Sequence[str]) -> None:
    if name not in existing:
        text = "null" if name is None else repr(name)
        hint = suggest(str(name), existing)
        raise GhptConfigError(group, f"there is no {text}", hint)


def _check_key(config: Any, key: str, added: bool) -> None:
    """Raise GhptConfigError if a composed configuration has no such key."""
    node = config
    parts = key.split(".")
    for depth, part in enumerate(parts):
        if isinstance(node, Mapping) and part in node:
            node = node[part]
            continue
        if added and depth:
            return  # whatever is built from it knows its settings
        existing: Iterable[object] = node if isinstance(node, Mapping) else []
        above = ".".join(parts[:depth])
        problem = f"no such setting in {above}" if above else "no such setting"
        raise GhptConfigError(key, problem, _suggest_key(config, existing, part, parts[-1]))


def _suggest_key(config: Any, existing: Iterable[object], part: str, last: str) -> str:
    """Suggest a key beside the missing ``part``, or one elsewhere whose last part is ``last``."""
    hint = suggest(part, existing)
    elsewhere = [path for path in _paths(config) if path.endswith(f".{last}")]
    if not elsewhere or "Did you mean" in hint:
        return hint
    return f"Did you mean {elsewhere[0]!r}? {hint}"


def _paths(node: Mapping[str, Any], above: str = "") -> Iterator[str]:
    """Yield the dotted keys of a configuration."""
    for key, value in node.items():
        path = f"{above}{key}"
        yield path
        if isinstance(value, Mapping):
            yield from _paths(value, f"{path}.")
