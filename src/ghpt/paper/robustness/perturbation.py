"""What can be wrong with detections and cameras, put on top of what a data set has: pure functions
of a batch.

Each is called as ``perturbation(batch, seed)``. A draw is a function of the seed, its purpose, the
sample and the camera's place in the rig, and not of the level: levels are nested (the outliers at
10 % are among those at 20 %, noise and rotations only grow), and everybody who is tested at a level
gets the same key points. The truth stays as it is.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
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
    """A share ``rate`` of the seen detections is found elsewhere: moved in a random direction, by a
    length between ``shortest`` and ``longest`` fractions of the person's size in the image. The
    confidence does not know.
    """

    rate: float
    shortest: float
    longest: float

    def __post_init__(self) -> None:
        _check_share(self.rate)

    def __call__(self, batch: Observations, seed: int) -> Observations:
        draw = uniform(_keys(batch, seed, "outliers"), (batch.valid.shape[-1], 3))
        length = torch.where(
            draw[..., 0] < self.rate,
            self.shortest + (self.longest - self.shortest) * draw[..., 1],
            0,
        )
        turn = 2 * torch.pi * draw[..., 2]
        return _moved(batch, length[..., None] * torch.stack((turn.cos(), turn.sin()), dim=-1))


@dataclass(frozen=True)
class Noise:
    """Gaussian noise on every seen detection, in each coordinate of deviation ``deviation`` x the
    person's size.
    """

    deviation: float

    def __call__(self, batch: Observations, seed: int) -> Observations:
        draw = _normal(_keys(batch, seed, "noise"), (batch.valid.shape[-1], 2))
        return _moved(batch, self.deviation * draw)


@dataclass(frozen=True)
class MissingDetections:
    """A share ``rate`` of the seen detections is not seen."""

    rate: float

    def __post_init__(self) -> None:
        _check_share(self.rate)

    def __call__(self, batch: Observations, seed: int) -> Observations:
        draw = uniform(_keys(batch, seed, "missing detections"), (batch.valid.shape[-1],))
        return replace(batch, valid=batch.valid & (draw >= self.rate))


@dataclass(frozen=True)
class MissingViews:
    """``count`` random views of each frame see nothing."""

    count: int

    def __call__(self, batch: Observations, seed: int) -> Observations:
        gone = _order(batch, seed, "missing views").argsort(dim=-1) < self.count
        return replace(batch, valid=batch.valid & ~gone[..., None])


@dataclass(frozen=True)
class FewerCameras:
    """The first ``count`` cameras in a random order, another for each frame: V = ``count``."""

    count: int

    def __call__(self, batch: Observations, seed: int) -> Observations:
        chosen = _order(batch, seed, "cameras")[:, : self.count]
        row = torch.arange(len(batch), device=chosen.device)[:, None]
        kept = {
            name: getattr(batch, name)[row, chosen]
            for name in ("key_points", "confidence", "valid")
        }
        return replace(batch, cameras=batch.cameras.index((row, chosen)), **kept)


@dataclass(frozen=True)
class RotatedCameras:
    """Each camera of each frame is thought to be turned by ``degrees`` about a random axis through
    its centre.
    """

    degrees: float

    def __call__(self, batch: Observations, seed: int) -> Observations:
        axis = _directions(_keys(batch, seed, "rotated cameras"))
        turn = vector_to_matrix(torch.deg2rad(torch.tensor(self.degrees, dtype=axis.dtype)) * axis)
        K = batch.cameras.K
        R = batch.cameras.R
        t = batch.cameras.t
        return replace(batch, cameras=Cameras(K, turn @ R, (turn @ t[..., None])[..., 0]))


@dataclass(frozen=True)
class ShiftedCameras:
    """Each camera of each frame is thought to be ``millimetres`` off in a random direction."""

    millimetres: float

    def __call__(self, batch: Observations, seed: int) -> Observations:
        shift = self.millimetres * _directions(_keys(batch, seed, "shifted cameras"))
        K = batch.cameras.K
        R = batch.cameras.R
        t = batch.cameras.t
        return replace(batch, cameras=Cameras(K, R, t - (R @ shift[..., None])[..., 0]))


def _check_share(rate: float) -> None:
    check(0 <= rate <= 1, "rate", f"is {rate}", "Give a share between 0 and 1.")


def _keys(batch: Observations, seed: int, purpose: str) -> Int[Tensor, "B V"]:
    device = batch.index.device
    camera = torch.arange(batch.valid.shape[1], device=device)
    return key(seed, purpose, *torch.broadcast_tensors(batch.index[:, None], camera), device=device)


def _order(batch: Observations, seed: int, purpose: str) -> Int[Tensor, "B V"]:
    """A random order of each frame's views."""
    keys = key(seed, purpose, batch.index, device=batch.index.device)
    return bits(keys, (batch.valid.shape[1],)).argsort(dim=-1)


def _moved(batch: Observations, offset: Float[Tensor, "B V J 2"]) -> Observations:
    """Seen detections moved by ``offset``, in the person's size in the view."""
    valid: Bool[Tensor, "B V J"] = batch.valid
    size = person_scale(batch.key_points, valid).to(offset.dtype)[..., None, None]
    moved = (batch.key_points + size * offset).to(batch.key_points.dtype)
    return replace(batch, key_points=torch.where(valid[..., None], moved, batch.key_points))


def _normal(keys: Int[Tensor, "*B"], shape: tuple[int, ...]) -> Float[Tensor, "..."]:
    """Standard normal numbers, float64 (Box and Muller)."""
    one, other = uniform(keys, (*shape, 2)).unbind(dim=-1)
    return (-2 * one.log()).sqrt() * (2 * torch.pi * other).cos()


def _directions(keys: Int[Tensor, "*B"]) -> Float[Tensor, "*B 3"]:
    """Unit vectors, uniform on the sphere."""
    return torch.nn.functional.normalize(_normal(keys, (3,)), dim=-1)
