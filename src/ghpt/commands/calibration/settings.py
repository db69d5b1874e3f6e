"""The settings of calibrate.py."""

from __future__ import annotations

from dataclasses import dataclass

from ghpt.calibration.millimetres import ScaleSettings
from ghpt.commands.inputs import InputSettings
from ghpt.config import Target, suggest
from ghpt.errors import check


@dataclass(frozen=True, kw_only=True)
class CalibrateSettings(InputSettings):
    """The settings of calibrate.py."""

    scale: ScaleSettings
    calibration: Target
    baselines: dict[str, Target]
    camera_check: Target
    estimator: str
    start_times: Target
    intrinsics: Target
    image_size: list[int] | None
    more_keypoints: list[str] | None
    evaluated_frames: int
    seed: int

    def __post_init__(self) -> None:
        super().__post_init__()
        frames = self.evaluated_frames
        check(frames >= 1, "evaluated_frames", f"is {frames}", "Give 1 or more.")
        if self.image_size is not None:
            sane = len(self.image_size) == 2 and min(self.image_size) > 0
            example = "Give width and height: image_size=[1920,1080]."
            check(sane, "image_size", f"is {self.image_size}", example)
            hint = "Give the image size or the cameras' file."
            check(not self.cameras, "image_size", "is given beside cameras", hint)
        hint = "Name the first detector's key points: keypoints=pose/"
        alone = bool(self.more_keypoints) and not self.keypoints
        check(not alone, "more_keypoints", "is given without keypoints", hint)
        name = self.estimator
        hint = suggest(name, self.baselines)
        check(name in self.baselines, "estimator", f"is {name!r}", hint)
