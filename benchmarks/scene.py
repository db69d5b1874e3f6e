"""Synthetic recordings of any length and number of cameras, made in moments, for benchmarks."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ghpt.data.datasets.datamodule import KeyPointDataModule
from ghpt.geometry.cameras import Cameras, project
from ghpt.observations import LabelledRecording

DATA = {
    "_target_": "scene.SceneData",
    "name": "scene",
    "root": None,
    "seed": 0,
    "train_samples": 512,
    "least_joints": 12,
    "stride": 1,
    "evaluate": "test",
    "batch_size": 16,
    "workers": 0,
}
"""The settings that all benchmarks share; ``cache``, ``views`` and ``frames`` are to be added."""

NOISE = 5.0
"""Deviation of the key points, pixels."""
_TAKE = 5000


def ring(views: int) -> Cameras:
    """Cameras all around at two heights, 5 m from the origin, focal length 1,100 pixels."""
    angles = np.linspace(0, 2 * np.pi, views, endpoint=False)
    tilts = np.where(np.arange(views) % 2, 0.1, 0.4)
    R = np.stack(
        [Rotation.from_euler("yx", [a, b]).as_matrix() for a, b in zip(angles, tilts, strict=True)]
    )
    K = np.array([[1100.0, 0, 500], [0, 1100, 500], [0, 0, 1]])
    t = np.array([0.0, 0, 5000])
    return Cameras(
        torch.from_numpy(K).expand(views, 3, 3),
        torch.from_numpy(R),
        torch.from_numpy(t).expand(views, 3),
    )


def take(name: str, frames: int, cameras: Cameras, rng: np.random.Generator) -> LabelledRecording:
    """One random body that shakes; ``NOISE`` on every key point and one in fifty unseen."""
    truth = rng.normal(0, 400, (17, 3)) + rng.normal(0, 60, (frames, 17, 3))
    pixels, _ = project(cameras, torch.from_numpy(truth))
    views = pixels.shape[1]
    return LabelledRecording(
        name=name,
        subject="S1",
        action="Walking",
        rate_hz=50.0,
        camera_names=tuple(f"c{i}" for i in range(views)),
        cameras=cameras,
        key_points=(pixels.numpy() + rng.normal(0, NOISE, pixels.shape)).astype(np.float32),
        confidence=rng.random((frames, views, 17), dtype=np.float32),
        valid=rng.random((frames, views, 17)) >= 0.02,
        truth=truth.astype(np.float32),
        truth_valid=np.ones((frames, 17), bool),
        frame=np.arange(frames),
    )


class SceneData(KeyPointDataModule):
    """``frames``: how many of each split, ``{"train": ..., "validation": ..., "test": ...}``."""

    def __init__(self, views: int, frames: dict[str, int], **settings: Any) -> None:
        super().__init__(**settings)
        self.views = views
        self.lengths = frames

    def cache_key(self, split: str) -> dict[str, Any]:
        return {"name": f"scene-{split}", "views": self.views, "frames": self.lengths[split]}

    def generate(self, split: str) -> Iterable[LabelledRecording]:
        rng = np.random.default_rng(len(split))
        cameras = ring(self.views)
        for first in range(0, self.lengths[split], _TAKE):
            yield take(f"{split}-{first}", min(_TAKE, self.lengths[split] - first), cameras, rng)
