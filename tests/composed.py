"""Configurations as a command line makes them, composed once for all tests of a process.

Hydra takes a quarter of a second to compose what a test asks for hundreds of times. The choices of
groups are composed by it, and remembered; the other words are set in a copy, by Hydra's own means.
"""

from __future__ import annotations

from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import hydra
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig

from ghpt.commands.calibration.settings import CalibrateSettings
from ghpt.commands.cameras import CamerasSettings
from ghpt.config import plain, settings

CONF = Path(__file__).resolve().parents[1] / "conf"
S = TypeVar("S")


def compose(name: str, *words: object, conf: Path = CONF) -> dict[str, Any]:
    """Return ``<conf>/<name>.yaml`` under these words as plain data, which the caller may change.

    The words ``output=unused`` go before them.
    """
    texts = ["output=unused", *map(str, words)]
    overrides = OverridesParser.create().parse_overrides(texts)
    groups = [o for o in overrides if (conf / o.key_or_group).is_dir()]
    values = [o for o in overrides if o not in groups]
    config = deepcopy(_of_groups(conf, name, tuple(str(o.input_line) for o in groups)))
    ConfigLoaderImpl._apply_overrides_to_config(values, config)
    return plain(config)


@cache
def _of_groups(conf: Path, name: str, words: tuple[str, ...]) -> DictConfig:
    with hydra.initialize_config_dir(str(conf), version_base="1.3"):
        return hydra.compose(name, list(words))


def cameras_settings(*words: str) -> CamerasSettings:
    """Return the settings of cameras.py."""
    return settings(CamerasSettings, compose("cameras", *words))


def calibrate_settings(*words: str) -> CalibrateSettings:
    """Return the settings of calibrate.py."""
    return settings(CalibrateSettings, compose("calibrate", *words))
