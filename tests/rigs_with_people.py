"""Synthetic people walking before real rigs, for the tests of calibration."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from omegaconf import OmegaConf
from torch import Tensor

from ghpt.calibration.rig import RigCalibration, RigEstimate
from ghpt.config import build
from ghpt.data.synthetic.recordings import draw_motion
from ghpt.data.synthetic.rigs import human36m_rig, panoptic_rig
from ghpt.geometry.cameras import Cameras, CameraSet, project
from ghpt.models.estimators.classical import person_scale

CONF = Path(__file__).resolve().parents[1] / "conf"


def calibration(**changed: object) -> RigCalibration:
    """conf/calibration/default.yaml, with top-level values changed."""
    return build(
        OmegaConf.to_container(OmegaConf.load(CONF / "calibration" / "default.yaml")) | changed,
        "calibration",
    )


@dataclass(frozen=True)
class Detections:
    """T frames of one person before a rig: what calibration gets, and the truth."""

    names: tuple[str, ...]
    K: Tensor
    key_points: Tensor
    valid: Tensor
    sizes: Tensor
    cameras: Cameras
    points: Tensor

    def views(self, chosen: list[int]) -> Detections:
        cameras = self.cameras.index(chosen)
        names = tuple(self.names[v] for v in chosen)
        parts = self.key_points[:, chosen], self.valid[:, chosen], self.sizes[chosen]
        return Detections(names, self.K[chosen], *parts, cameras, self.points)

    def changed(self, view: int, key_points: Tensor) -> Detections:
        """With other key points in one view."""
        all_views = self.key_points.clone()
        all_views[:, view] = key_points
        return replace(self, key_points=all_views)

    def calibrate(self, calibration: RigCalibration, sizes: bool = True) -> RigEstimate:
        confidence = torch.ones(self.valid.shape, dtype=torch.float64)
        size = self.sizes if sizes else None
        return calibration(self.names, self.K, self.key_points, confidence, self.valid, size, 0)


@cache
def _walk(frames: int, seed: int) -> np.ndarray:
    takes = ("Walking", "Greeting", "Phoning", "WalkingDog")
    return np.concatenate(
        [draw_motion(seed, "S8", f"S8/{a}-1", a, 8 * frames, 50.0)[::32] for a in takes]
    )[:frames]


def people(rig: str = "h36m", frames: int = 80, noise: float = 0.01, seed: int = 0) -> Detections:
    """``noise``: standard deviation of a pixel coordinate in persons' sizes; ``rig``: h36m or
    cmu3."""
    found: CameraSet = human36m_rig("S8") if rig == "h36m" else panoptic_rig((10, 12, 16, 18))
    points = torch.from_numpy(_walk(frames, seed))
    if rig != "h36m":  # Panoptic's y points down
        points = torch.stack((points[..., 0], -points[..., 2], points[..., 1]), dim=-1)
    exact, depth = project(found.cameras.index(None), points)
    size = person_scale(exact, depth > 0)
    random = torch.randn(
        exact.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)
    )
    key_points = exact + noise * size[..., None, None] * random
    valid = (
        (depth > 0) & (key_points >= 0).all(-1) & (key_points <= found.size[:, None] - 1).all(-1)
    )
    return Detections(
        found.names, found.cameras.K, key_points, valid, found.size, found.cameras, points
    )


def relative(cameras: Cameras, a: int, b: int) -> tuple[Tensor, Tensor]:
    """R, t of ``x_b = R x_a + t``."""
    return cameras.relative_pose(a, b)
