"""A scene factory: a person-sized pose in random rigs of V cameras, with exact projections, in
float64.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ghpt.geometry.cameras import Cameras, project
from ghpt.observations import Labelled, Observations, PairObservations, PairTruth, select_views

_STANDING = {
    "right_ankle": (-120, 0, 80),
    "right_knee": (-130, 40, 500),
    "right_hip": (-130, 0, 950),
    "left_hip": (130, 0, 950),
    "left_knee": (130, 30, 500),
    "left_ankle": (120, 0, 80),
    "pelvis": (0, 0, 950),
    "spine": (0, 20, 1200),
    "thorax": (0, 0, 1450),
    "head_top": (0, 0, 1750),
    "right_wrist": (-400, 150, 950),
    "right_elbow": (-330, 30, 1150),
    "right_shoulder": (-180, 0, 1420),
    "left_shoulder": (180, 0, 1420),
    "left_elbow": (330, 30, 1150),
    "left_wrist": (400, 150, 950),
    "nose": (0, 100, 1600),
}


@dataclass(frozen=True)
class Scene:
    """B frames: cameras with leading dimensions B V, points [B, J, 3] in mm, their exact pixels [B,
    V, J, 2].
    """

    cameras: Cameras
    points: Tensor
    key_points: Tensor

    def batch(self, valid: Tensor | None = None, confidence: Tensor | None = None) -> Observations:
        """The frames as a batch; everything seen with confidence 1 unless told."""
        shape = self.key_points.shape[:-1]
        valid = torch.ones(shape, dtype=torch.bool) if valid is None else valid
        return Observations(
            index=torch.arange(shape[0]),
            recording=torch.zeros(shape[0], dtype=torch.int64),
            cameras=self.cameras,
            key_points=self.key_points,
            valid=valid,
            confidence=torch.ones(shape, dtype=self.points.dtype)
            if confidence is None
            else confidence,
        )

    def noisy(self, sigma: float, seed: int) -> Scene:
        """The same with Gaussian noise of ``sigma`` pixels on the key points."""
        noise = np.random.default_rng(seed).normal(0, sigma, tuple(self.key_points.shape))
        return replace(self, key_points=self.key_points + torch.from_numpy(noise))


def labelled_pairs(
    rigs: Cameras,
    pair: Tensor,
    key_points: Tensor,
    valid: Tensor | None = None,
    points: Tensor | None = None,
    draw: Tensor | None = None,
) -> Labelled[PairObservations, PairTruth]:
    """Pairs of views of B rigs [B, V] with their key points [B, V, M, J, 2]; each its own draw."""
    count = torch.arange(len(pair))
    shape = key_points.shape[:-1]
    cameras = Cameras(*(select_views(values, pair) for values in (rigs.K, rigs.R, rigs.t)))
    observations = PairObservations(
        index=count,
        rig=count,
        draw=count if draw is None else draw,
        pair=pair,
        K=rigs.K,
        baseline=(cameras.centre[:, 1] - cameras.centre[:, 0]).norm(dim=-1),
        key_points=key_points,
        confidence=torch.ones(shape, dtype=key_points.dtype),
        valid=torch.ones(shape, dtype=torch.bool) if valid is None else valid,
    )
    if points is None:
        points = torch.zeros(len(pair), 1, 3, dtype=torch.float64)
    return Labelled(observations, PairTruth(cameras, points))


def random_scene(
    seed: int, frames: int = 2, views: int = 4, scale: float = 1.0, place: float = 0.0
) -> Scene:
    """Random poses, and for each frame its own rig of cameras 3 to 6 m around the person, all
    looking at it.

    ``scale`` scales the whole scene (1e-3: metres); ``place`` puts it so far (mm) from the world's
    origin. No two cameras see a joint along one line.
    """
    rng = np.random.default_rng(seed)
    points = np.array(list(_STANDING.values()), dtype=np.float64) + rng.normal(
        0, 60, (frames, 17, 3)
    )
    points = points - [0, 0, 950]
    centre = np.empty((frames, views, 3))
    for frame in range(frames):
        centre[frame] = _directions(rng, views) * rng.uniform(3000, 6000, (views, 1))
    offset = rng.normal(size=(frames, 1, 3))
    offset *= place / np.linalg.norm(offset, axis=-1, keepdims=True)
    target = rng.normal(0, 150, (frames, views, 3))
    R = look_at(centre, target, rng.normal(size=(frames, views, 3)))
    focal = rng.uniform(600, 2500, (frames, views))
    K = np.zeros((frames, views, 3, 3))
    K[..., 0, 0], K[..., 1, 1] = focal, focal * rng.uniform(0.97, 1.03, (frames, views))
    K[..., :2, 2], K[..., 2, 2] = rng.uniform(400, 1000, (frames, views, 2)), 1
    points, centre = (points + offset) * scale, (centre + offset) * scale
    t = -(R @ centre[..., None])[..., 0]
    cameras = Cameras(*(torch.from_numpy(x) for x in (K, R, t)))
    exact = torch.from_numpy(points)
    return Scene(cameras, exact, project(cameras, exact)[0])


def look_at(centre: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """World to camera rotations [..., 3, 3] of cameras at ``centre`` whose z axis points at
    ``target``.
    """
    z = target - centre
    z = z / np.linalg.norm(z, axis=-1, keepdims=True)
    x = np.cross(up, z)
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-2)


def _directions(rng: np.random.Generator, count: int) -> np.ndarray:
    """Random unit vectors, each at least 0.2 / sqrt(count) rad from the line of any other."""
    found: list[np.ndarray] = []
    while len(found) < count:
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        if all(
            np.linalg.norm(np.cross(direction, other)) > 0.2 / np.sqrt(count) for other in found
        ):
            found.append(direction)
    return np.stack(found)
