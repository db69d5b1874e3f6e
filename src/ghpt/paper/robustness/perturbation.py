"""What can be wrong with detections and cameras, on top of what a data set has.

Each perturbation is a pure function of a batch, called as ``perturbation(batch, seed)``. A draw is
a function of the seed, its purpose, the sample and the camera's place in the rig, and not of the
level: levels are nested (the outliers at 10 % are among those at 20 %, noise and rotations only
grow), and every estimator that is tested at a level gets the same key points. The truth stays as it
is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ghpt.errors import check
from ghpt.geometry.cameras import Cameras
from ghpt.geometry.rotations import vector_to_matrix
from ghpt.models.estimators.classical import person_scale
from ghpt.observations import Observations
from ghpt.randomness import bits, key, uniform

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

    def __post_init__(self) -> None:
        _check_share(self.rate)

    def __call__(self, batch: Observations, seed: int) -> Observations:
        joints = batch.valid.shape[-1]
        keys = _keys(batch, seed, "outliers")
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
        noise = _normal(_keys(batch, seed, "noise"), (joints, 2))
        return _displace(batch, self.deviation * noise)


@dataclass(frozen=True)
class MissingDetections:
    """Takes a share ``rate`` of the valid detections away."""

    rate: float

    def __post_init__(self) -> None:
        _check_share(self.rate)

    def __call__(self, batch: Observations, seed: int) -> Observations:
        joints = batch.valid.shape[-1]
        chance = uniform(_keys(batch, seed, "missing detections"), (joints,))
        return replace(batch, valid=batch.valid & (chance >= self.rate))


@dataclass(frozen=True)
class MissingViews:
    """Takes all detections of ``count`` random views of each frame away."""

    count: int

    def __call__(self, batch: Observations, seed: int) -> Observations:
        rank = _order(batch, seed, "missing views").argsort(dim=-1)
        kept = rank >= self.count
        return replace(batch, valid=batch.valid & kept[..., None])


@dataclass(frozen=True)
class FewerCameras:
    """Keeps the first ``count`` cameras in a random order, another for each frame."""

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
    """Rotates each camera of each frame by ``degrees`` about a random axis through its centre."""

    degrees: float

    def __call__(self, batch: Observations, seed: int) -> Observations:
        axis = _directions(_keys(batch, seed, "rotated cameras"))
        angle = torch.deg2rad(torch.tensor(self.degrees, dtype=axis.dtype))
        rotation = vector_to_matrix(angle * axis)
        cameras = batch.cameras
        R = rotation @ cameras.R
        t = rotation @ cameras.t[..., None]
        return replace(batch, cameras=Cameras(cameras.K, R, t[..., 0]))


@dataclass(frozen=True)
class ShiftedCameras:
    """Shifts each camera of each frame by ``millimetres`` in a random direction."""

    millimetres: float

    def __call__(self, batch: Observations, seed: int) -> Observations:
        shift = self.millimetres * _directions(_keys(batch, seed, "shifted cameras"))
        cameras = batch.cameras
        change = cameras.R @ shift[..., None]
        t = cameras.t - change[..., 0]
        return replace(batch, cameras=Cameras(cameras.K, cameras.R, t))


def _check_share(rate: float) -> None:
    check(0 <= rate <= 1, "rate", f"is {rate}", "Give a share between 0 and 1.")


def _keys(batch: Observations, seed: int, purpose: str) -> Int[Tensor, "B V"]:
    """Return a random key for each view of each frame."""
    device = batch.index.device
    views = torch.arange(batch.valid.shape[1], device=device)
    frames, views = torch.broadcast_tensors(batch.index[:, None], views)
    return key(seed, purpose, frames, views, device=device)


def _order(batch: Observations, seed: int, purpose: str) -> Int[Tensor, "B V"]:
    """Return a random order of each frame's views."""
    views = batch.valid.shape[1]
    keys = key(seed, purpose, batch.index, device=batch.index.device)
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
