"""The settings of cameras.py and calibrate.py, as a command line gives them."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import hydra

from ghpt.commands.calibrate import CalibrateSettings
from ghpt.commands.cameras import CamerasSettings
from ghpt.config import plain, settings

CONF = Path(__file__).resolve().parents[1] / "conf"
S = TypeVar("S")


def cameras_settings(*words: str) -> CamerasSettings:
    return _compose("cameras", CamerasSettings, words)


def calibrate_settings(*words: str) -> CalibrateSettings:
    return _compose("calibrate", CalibrateSettings, words)


def _compose(name: str, kind: type[S], words: tuple[str, ...]) -> S:
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        return settings(kind, plain(hydra.compose(name, ["output=unused", *words])))
