"""What can be wrong with detections and cameras, on top of what a data set has.

Each perturbation is a pure function of a batch, called as ``perturbation(batch, seed)``. A draw is
a function of the seed, its purpose, the camera's place in the rig and the sample, and not of the
level: levels are nested (the outliers at 10 % are among those at 20 %, noise and rotations only
grow), and every estimator that is tested at a level gets the same key points. What is wrong with a
camera is wrong for a whole recording. What lasts for ``frames`` is the same in so many successive
samples. The truth stays as it is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ghpt.errors import check, check_positive
from ghpt.geometry.cameras import Cameras, project
from ghpt.geometry.rotations import vector_to_matrix
from ghpt.geometry.triangulation import triangulate
from ghpt.models.estimators.classical import person_scale
from ghpt.observations import Observations
from ghpt.randomness import bits, key, uniform
from ghpt.skeleton import MIRROR, PELVIS

Perturbation = Callable[[Observations, int], Observations]


@dataclass(frozen=True)
class Outliers:
    """Displaces a share ``rate`` of the valid detections in a random direction.

    The length is between ``shortest`` and ``longest`` fractions of the person's size in the image.
    The confidence stays as it was.
    """

    rate: float
    shortest: float
    longest: float
    frames: int = 1

    def __post_init__(self) -> None:
        _check_share(self.rate)
        check_positive(frames=self.frames)

    def __call__(self, batch: Observations, seed: int) -> Observations:
        joints = batch.valid.shape[-1]
        keys = _keys(batch, seed, "outliers", batch.index // self.frames)
        chance, place, turn = uniform(keys, (joints, 3)).unbind(-1)
        length = self.shortest + (self.longest - self.shortest) * place
        length = torch.where(chance < self.rate, length, 0)
        angle = 2 * torch.pi * turn
        direction = torch.stack((angle.cos(), angle.sin()), dim=-1)
        return _displace(batch, length[..., None] * direction)


@dataclass(frozen=True)
class Noise:
    """Adds Gaussian noise to every valid detection.

    The standard deviation of each coordinate is ``deviation`` times the person's size in the image.
    """

    deviation: float

    def __call__(self, batch: Observations, seed: int) -> Observations:
        joints = batch.valid.shape[-1]
        noise = _normal(_keys(batch, seed, "noise", batch.index), (joints, 2))
        return _displace(batch, self.deviation * noise)


@dataclass(frozen=True)
class FlippedViews:
    """Exchanges left and right in a share ``rate`` of the views, for so many ``frames``."""

    rate: float
    frames: int

    def __post_init__(self) -> None:
        _check_share(self.rate)
        check_positive(frames=self.frames)

    def __call__(self, batch: Observations, seed: int) -> Observations:
        keys = _keys(batch, seed, "flipped views", batch.index // self.frames)
        flipped = uniform(keys, (1,)) < self.rate
        mirror = list(MIRROR)
        return replace(
            batch,
            key_points=torch.where(
                flipped[..., None], batch.key_points[:, :, mirror], batch.key_points
            ),
            confidence=torch.where(flipped, batch.confidence[:, :, mirror], batch.confidence),
            valid=torch.where(flipped, batch.valid[:, :, mirror], batch.valid),
        )


@dataclass(frozen=True)
class OtherPeople:
    """Shows somebody else in a share ``rate`` of the views, for so many ``frames``.

    The other person has the pose of the first, turned about the vertical (z) and ``nearest`` to
    ``farthest`` mm away; all views that show somebody else show the same one. The errors of the
    detector stay as they were.
    """

    rate: float
    frames: int
    nearest: float
    farthest: float

    def __post_init__(self) -> None:
        _check_share(self.rate)
        check_positive(frames=self.frames)

    def __call__(self, batch: Observations, seed: int) -> Observations:
        block = batch.index // self.frames
        shown = uniform(_keys(batch, seed, "other people", block), (1,)) < self.rate
        found = triangulate(batch.cameras, batch.key_points, batch.valid.double())
        own = torch.where(found.ok[..., None], found.points, 0.0)
        draws = uniform(key(seed, "another person", block, device=block.device), (3,))
        projected, depth = project(batch.cameras, self._displace(own, draws))
        before, _ = project(batch.cameras, own)
        moved = (batch.key_points + projected - before).to(batch.key_points.dtype)
        visible = found.ok[:, None] & (depth > 0)
        key_points = torch.where((shown & visible)[..., None], moved, batch.key_points)
        valid = batch.valid & (visible | ~shown)
        unseen = ~valid[..., None]
        return replace(
            batch, key_points=torch.where(unseen, batch.key_points, key_points), valid=valid
        )

    def _displace(
        self, own: Float[Tensor, "B J 3"], draws: Float[Tensor, "B 3"]
    ) -> Float[Tensor, "B J 3"]:
        """Return the other person's joints; ``draws`` are uniform."""
        turn, direction, place = draws.unbind(-1)
        zero = torch.zeros_like(turn)
        vertical = torch.stack((zero, zero, 2 * torch.pi * turn), dim=-1)
        angle = 2 * torch.pi * direction
        horizontal = torch.stack((angle.cos(), angle.sin(), zero), dim=-1)
        distance = self.nearest + (self.farthest - self.nearest) * place
        pelvis = own[:, PELVIS, None]
        turned = (own - pelvis) @ vector_to_matrix(vertical).mT + pelvis
        return turned + (distance[:, None] * horizontal)[:, None]


@dataclass(frozen=True)
class MissingDetections:
    """Takes a share ``rate`` of the valid detections away."""

    rate: float

    def __post_init__(self) -> None:
        _check_share(self.rate)

    def __call__(self, batch: Observations, seed: int) -> Observations:
        joints = batch.valid.shape[-1]
        keys = _keys(batch, seed, "missing detections", batch.index)
        chance = uniform(keys, (joints,))
        return replace(batch, valid=batch.valid & (chance >= self.rate))


@dataclass(frozen=True)
class MissingViews:
    """Takes all detections of ``count`` random views of each recording away."""

    count: int

    def __call__(self, batch: Observations, seed: int) -> Observations:
        rank = _order(batch, seed, "missing views").argsort(dim=-1)
        kept = rank >= self.count
        return replace(batch, valid=batch.valid & kept[..., None])


@dataclass(frozen=True)
class FewerCameras:
    """Keeps the first ``count`` cameras in a random order, another for each recording."""

    count: int

    def __call__(self, batch: Observations, seed: int) -> Observations:
        views = _order(batch, seed, "cameras")[:, : self.count]
        rows = torch.arange(len(batch), device=views.device)[:, None]
        return replace(
            batch,
            cameras=batch.cameras.index((rows, views)),
            key_points=batch.key_points[rows, views],
            confidence=batch.confidence[rows, views],
            valid=batch.valid[rows, views],
        )


@dataclass(frozen=True)
class RotatedCameras:
    """Rotates each camera by ``degrees`` about a random axis through its centre."""

    degrees: float

    def __call__(self, batch: Observations, seed: int) -> Observations:
        axis = _directions(_keys(batch, seed, "rotated cameras", batch.recording))
        angle = torch.deg2rad(torch.tensor(self.degrees, dtype=axis.dtype))
        rotation = vector_to_matrix(angle * axis)
        cameras = batch.cameras
        R = rotation @ cameras.R
        t = rotation @ cameras.t[..., None]
        return replace(batch, cameras=Cameras(cameras.K, R, t[..., 0]))


@dataclass(frozen=True)
class ShiftedCameras:
    """Shifts each camera by ``millimetres`` in a random direction."""

    millimetres: float

    def __call__(self, batch: Observations, seed: int) -> Observations:
        direction = _directions(_keys(batch, seed, "shifted cameras", batch.recording))
        shift = self.millimetres * direction
        cameras = batch.cameras
        change = cameras.R @ shift[..., None]
        t = cameras.t - change[..., 0]
        return replace(batch, cameras=Cameras(cameras.K, cameras.R, t))


def _check_share(rate: float) -> None:
    check(0 <= rate <= 1, "rate", f"is {rate}", "Give a share between 0 and 1.")


def _keys(
    batch: Observations, seed: int, purpose: str, item: Int[Tensor, " B"]
) -> Int[Tensor, "B V"]:
    """Return a random key for each view of each ``item``."""
    views = torch.arange(batch.valid.shape[1], device=item.device)
    items, views = torch.broadcast_tensors(item[:, None], views)
    return key(seed, purpose, items, views, device=item.device)


def _order(batch: Observations, seed: int, purpose: str) -> Int[Tensor, "B V"]:
    """Return a random order of the views of each frame's recording."""
    views = batch.valid.shape[1]
    keys = key(seed, purpose, batch.recording, device=batch.index.device)
    return bits(keys, (views,)).argsort(dim=-1)


def _displace(batch: Observations, offset: Float[Tensor, "B V J 2"]) -> Observations:
    """Displace the valid detections by ``offset``, in the person's size in the view."""
    key_points = batch.key_points
    size = person_scale(key_points, batch.valid).to(offset.dtype)
    displaced = key_points + size[..., None, None] * offset
    valid = batch.valid[..., None]
    displaced = torch.where(valid, displaced.to(key_points.dtype), key_points)
    return replace(batch, key_points=displaced)


def _normal(keys: Int[Tensor, "*B"], shape: tuple[int, ...]) -> Float[Tensor, ...]:
    """Return standard normal numbers, float64 (Box and Muller)."""
    one, other = uniform(keys, (*shape, 2)).unbind(dim=-1)
    radius = (-2 * one.log()).sqrt()
    angle = 2 * torch.pi * other
    return radius * angle.cos()


def _directions(keys: Int[Tensor, "*B"]) -> Float[Tensor, "*B 3"]:
    """Return unit vectors, uniform on the sphere."""
    return torch.nn.functional.normalize(_normal(keys, (3,)), dim=-1)
