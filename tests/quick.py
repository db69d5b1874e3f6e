"""What makes the tests quick and changes none of their results.

1. Yaml is parsed by libyaml, and a file of the configuration once in a process.
2. Hydra composes a configuration once in a process, which asks for it many hundred times: which
   files a command line chooses, and what they come to together, is remembered with the state of
   the files. Values are set in a copy each time, by Hydra itself.
3. Nobody waits until a disk has what is written. A process that is killed loses nothing by that;
   what is synchronized, and in which order, is tested where the calls are counted.
"""

from __future__ import annotations

import os
import pickle
from collections.abc import Iterator
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import omegaconf._utils
import yaml
from hydra._internal import config_loader_impl
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra._internal.defaults_list import DefaultsList
from hydra.plugins.config_source import ConfigResult


def make_quick() -> None:
    """Do all of this in this process."""
    if hasattr(yaml, "CSafeLoader"):
        loader = _loader()
        omegaconf._utils.get_yaml_loader = lambda: loader
    FileConfigSource.load_config = _remembered_file
    config_loader_impl.create_defaults_list = _remembered_list
    ConfigLoaderImpl._compose_config_from_defaults_list = _remembered_composition
    os.fsync = lambda handle: None


def _loader() -> Any:
    """Return OmegaConf's loader, derived from libyaml's; the same one each time."""
    with patch.object(yaml, "SafeLoader", yaml.CSafeLoader):
        return omegaconf._utils.get_yaml_loader()


_files: dict[Any, bytes] = {}
_lists: dict[Any, DefaultsList] = {}
_compositions: dict[Any, bytes] = {}
_load = FileConfigSource.load_config
_list = config_loader_impl.create_defaults_list
_compose = ConfigLoaderImpl._compose_config_from_defaults_list


def _remembered_file(source: FileConfigSource, config_path: str) -> ConfigResult:
    path = os.path.join(source.path, source._normalize_file_name(config_path))
    if not os.path.exists(path):
        return _load(source, config_path)
    state = os.stat(path)
    key = (source.provider, path, state.st_mtime_ns, state.st_size)
    if key not in _files:
        _files[key] = pickle.dumps(_load(source, config_path))
    return pickle.loads(_files[key])


def _remembered_list(
    repo: Any, config_name: str | None, overrides_list: list[Any], **how: bool
) -> DefaultsList:
    groups = [o for o in overrides_list if repo.group_exists(o.key_or_group)]
    if any(o.is_sweep_override() or isinstance(o.value(), dict) for o in groups):
        return _list(repo, config_name, overrides_list, **how)
    words = tuple(str(o.input_line) for o in groups)
    key = (_sources(repo), config_name, words, *how.values())
    if key not in _lists:
        _lists[key] = _list(repo, config_name, groups, **how)
    values = [o for o in overrides_list if o not in groups and not o.is_sweep_override()]
    return replace(_lists[key], config_overrides=values)


def _remembered_composition(loader: ConfigLoaderImpl, defaults: list[Any], repo: Any) -> Any:
    key = (_sources(repo), tuple((one.config_path, one.package) for one in defaults))
    if key not in _compositions:
        _compositions[key] = pickle.dumps(_compose(loader, defaults, repo))
    return pickle.loads(_compositions[key])


def _sources(repo: Any) -> tuple[object, ...]:
    """Return what identifies the folders' files and their states; copies of a folder are alike."""
    found: list[object] = []
    for source in repo.get_sources():
        folder = source.path.removeprefix("file://")
        found += [source.provider, source.path] if folder == source.path else _states(folder)
    return tuple(found)


def _states(folder: str) -> Iterator[tuple[str, int, int]]:
    """Yield name, time and size of each file in a folder and below it."""
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_dir():
                yield from _states(entry.path)
            else:
                state = entry.stat()
                yield f"{os.path.basename(folder)}/{entry.name}", state.st_mtime_ns, state.st_size
