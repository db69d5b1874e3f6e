"""A synthetic recording of any length, and predict.py's configuration, for the tests of
prediction."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from composed import CONF as CONF
from composed import compose
from ghpt.commands.predict import predict
from ghpt.commands.prediction.settings import PredictSettings
from ghpt.config import settings
from ghpt.data.formats.camera_writers import write_pose2sim
from ghpt.data.people.sequence import Sequence
from ghpt.data.points import KeyPoints
from ghpt.data.synthetic.recordings import draw_motion
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.geometry.cameras import Cameras, CameraSet, project

QUICK = (
    "trainer.accelerator=cpu",
    "progress_bar=false",
    "evaluated_frames=4",
    "camera_check.clean=1.0",
)
"""The camera check, which takes seconds, is not asked: tests/test_verdict.py asks it."""


def config(*words: str) -> PredictSettings:
    """conf/predict.yaml with these overrides, as predict.py gets it."""
    return settings(PredictSettings, compose("predict", *QUICK, *words))


def numbers_of(settings: PredictSettings, output: Path) -> dict[str, Any]:
    """Predict, and return what prediction.json holds."""
    result = predict(settings, output)
    assert result is not None
    return result.plain()


@cache
def walk(frames: int = 200) -> Tensor:
    """A walking person, mm [T, 17, 3]."""
    return torch.from_numpy(draw_motion(0, "S9", "S9/Walking-1", "Walking", frames, 50.0)).double()


@dataclass(frozen=True)
class EndlessWalk:
    """The key points of a walk that goes on and on, made as they are read."""

    pixels: np.ndarray
    noise: float
    gaps: float

    def undistorted(self, rows: np.ndarray) -> KeyPoints:
        shape = (len(rows), *self.pixels.shape[1:3])
        # a stream of its own for each frame, so that a frame is the same however it is read
        cell = np.arange(shape[1] * shape[2]).reshape(shape[1:])
        random = (rows[:, None, None] * 7919 + cell * 104729) % 65521 / 65521
        values = self.pixels[rows % len(self.pixels)]
        values = values + self.noise * np.sin(40 * random)[..., None]
        valid = random >= self.gaps
        pixels = np.where(valid[..., None], values, 0).astype(np.float32)
        return KeyPoints(pixels, valid.astype(np.float32), valid)

    detected = undistorted


def sequence_of(count: int, noise: float = 1.0, gaps: float = 0.1) -> Sequence:
    """A walk repeated ``count`` frames long, before Human3.6M's cameras; made as it is read."""
    rig = human36m_rig("S9").without_distortion()
    pixels = project(rig.cameras, walk())[0].numpy()
    points = EndlessWalk(pixels, noise, gaps)
    return Sequence("walk", "synthetic", rig, np.arange(count), 50.0, points)


def cameras_file(folder: Path) -> Path:
    """Human3.6M's cameras of S9 with perfect lenses, named cam_00 to cam_03."""
    rig = human36m_rig("S9")
    names = tuple(f"cam_{i:02d}" for i in range(len(rig)))
    write_pose2sim(
        folder / "cameras.toml",
        CameraSet.from_cameras(names, rig.cameras, 0 * rig.distortion, rig.size),
        {},
    )
    return folder / "cameras.toml"


def openpose_folders(folder: Path, frames: list[int], cameras: Cameras | None = None) -> Path:
    """A JSON file for each camera and frame number: the walk's pose of that number, seen
    exactly."""
    pixels = project(cameras or human36m_rig("S9").cameras, walk())[0]
    for view in range(pixels.shape[1]):
        (folder / f"cam{view}_json").mkdir(parents=True)
        for frame in frames:
            write_people(
                folder / f"cam{view}_json" / f"cam{view}_{frame:06d}.json", [pixels[frame, view]]
            )
    return folder


def write_people(path: Path, people: list[Tensor]) -> None:
    """An OpenPose file; joints that are not finite are missing."""
    rows = []
    for person in people:
        values = torch.cat([person, torch.ones(len(person), 1, dtype=person.dtype)], dim=-1)
        values = torch.where(values.isfinite().all(-1, keepdim=True), values, 0.0)
        rows.append({"pose_keypoints_2d": values.flatten().tolist()})
    path.write_text(json.dumps({"people": rows}), encoding="utf-8")
