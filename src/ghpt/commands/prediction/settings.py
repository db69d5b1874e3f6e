"""The settings of predict.py."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from ghpt.commands.inputs import InputSettings
from ghpt.config import Target, suggest
from ghpt.errors import check
from ghpt.export import WRITERS

TRAJECTORY = "trajectory"
"""The estimator of all frames together."""
ONLINE = "online"
"""The same while they are recorded."""
ALIASES = {"frame": "adaptive_ransac"}
"""Other names of baselines."""
_DEFAULTS = {
    "person": None,
    "ckpt": None,
    "joints": "detector",
    "world": "cameras",
    "floor": None,
    "markers": None,
}
"""Of conf/predict.yaml, which the commands to type next repeat where they are others."""


@dataclass(frozen=True)
class PredictorSettings:
    """How key points become joints: frame by frame, by a checkpoint's model, or together."""

    classical: Target
    learned: Target
    trajectory: Target
    online: Target


@dataclass(frozen=True, kw_only=True)
class PredictSettings(InputSettings):
    """The settings of predict.py."""

    videos: str | None
    person: int | None
    joints: Literal["detector", "human36m"]
    ckpt: str | None
    trust: list[str]
    hypotheses: int | None
    estimator: str
    lag: float
    fill: int | str | None
    interpolation: str | None
    smooth: float | None
    formats: list[str] | None
    trc: dict[str, Any]
    markers: str | None
    world: Literal["cameras", "people", "first"]
    floor: list[str] | None
    compare: list[str]
    evaluated_frames: int
    shard_frames: int
    batch: int
    progress_bar: bool
    baselines: dict[str, Target]
    peers: dict[str, Target]
    trainer: dict[str, Any]
    flips: bool
    predictor: PredictorSettings
    fitted_frames: int
    camera_check: Target
    verdict: Target
    strict: bool
    seed: int

    def non_defaults(self) -> dict[str, object]:
        """Return what says whose joints are written how, where it is not the default."""
        values = {name: getattr(self, name) for name in _DEFAULTS}
        return {name: value for name, value in values.items() if value != _DEFAULTS[name]}

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("evaluated_frames", "fitted_frames", "shard_frames", "batch"):
            count = getattr(self, name)
            check(count >= 1, name, f"is {count}", "Give 1 or more.")
        if not self.ckpt:
            names = (TRAJECTORY, ONLINE, *ALIASES, *self.baselines)
            _check_exists("estimator", self.estimator, dict.fromkeys(names))
        for name in self.compare:
            _check_exists("compare", name, self.baselines | self.peers)
        for name in self.formats or ():
            _check_exists("formats", name, WRITERS)
            WRITERS[name].check_installed(name)


def _check_exists(key: str, name: str, existing: Mapping[str, object]) -> None:
    check(name in existing, key, f"there is no {name!r}", suggest(name, existing))
