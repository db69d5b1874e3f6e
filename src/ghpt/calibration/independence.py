"""What a recording is worth: how long the errors of key points last, and how far people turn."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.calibration.observations import Correspondences
from ghpt.calibration.resection import PlacedRig
from ghpt.skeleton import JOINT

_CLIP = 3.0
"""Units of noise; larger errors say nothing of how long errors last."""
_DECAYED = 0.05
"""A smaller correlation counts as none, and so do those of all longer lags."""
_ROUNDS = 20
"""Of the correction for the mean, which is taken from errors of the same recording."""
_SECTOR = 60.0
"""Degrees; people who face so far apart show a detector different sides, with errors of their own.
"""
_LEAST_SHARE = 0.02
"""Of the frames, for a sector to count."""
_SIDES = (
    (JOINT["left_shoulder"], JOINT["right_shoulder"]),
    (JOINT["left_hip"], JOINT["right_hip"]),
)


@dataclass(frozen=True)
class Persistence:
    """How long the errors of key points last, in frames used."""

    frames: int
    correlation: Float[Tensor, " L"]
    """Of errors 1, 2, ... frames apart, up to where it is none."""

    @property
    def time(self) -> float:
        """The number of frames that are worth one: 1 plus twice the sum of the correlations."""
        return 1.0 + 2.0 * float(self.correlation.sum())

    @property
    def independent(self) -> float:
        """The number of independent frames that all are worth."""
        return self.frames / self.time

    def share(self, length: float) -> float:
        """Return the share of the variance of a mean that blocks of so many frames show."""
        lag = torch.arange(1, len(self.correlation) + 1, dtype=torch.float64)
        within = (1 - lag / max(length, 1.0)).clamp(min=0.0)
        return (1.0 + 2.0 * float((within * self.correlation).sum())) / self.time


def persistence(observed: Correspondences, rig: PlacedRig) -> Persistence:
    """Return how long the errors of a rig's inliers last, averaged over views and joints.

    What lasts through the whole recording is not in it. The mean that is subtracted is itself of
    the recording, which lowers each correlation by the share of its variance; that is undone.
    """
    frames = observed.frames
    if frames < 2 or not rig.inlier.any():
        return Persistence(frames, torch.zeros(0, dtype=torch.float64))
    error, there = _series(observed, rig, frames)
    count = there.sum(0).clamp(min=1)
    error = torch.where(there, error - (error * there).sum(0) / count, 0.0)
    frame = torch.arange(frames)
    lag = (frame - frame[:, None]).abs().flatten()
    nothing = torch.zeros(frames, dtype=torch.float64)
    product = nothing.index_add(0, lag, (error @ error.T).flatten())
    pairs = nothing.index_add(0, lag, (there.double() @ there.double().T).flatten())
    covariance = (product / pairs.clamp(min=1.0))[: frames // 2 + 1]
    seen = covariance[1:] / covariance[0].clamp(min=1e-300)
    correlation = seen[:0]
    for _ in range(_ROUNDS):
        time = 1.0 + 2.0 * float(correlation.sum())
        missing = min(time / frames, 0.5)
        whole = seen * (1 - missing) + missing
        decayed = torch.nonzero(whole < _DECAYED)
        last = int(decayed[0]) if len(decayed) else len(whole)
        correlation = whole[:last]
    return Persistence(frames, correlation)


def _series(
    observed: Correspondences, rig: PlacedRig, frames: int
) -> tuple[Float[Tensor, "T S"], Bool[Tensor, "T S"]]:
    """Return the errors (units of noise) of S coordinates of views and joints over the frames, and
    where there are any.
    """
    x = rig.points @ rig.R.mT + rig.t[:, None]
    ahead = rig.inlier & (x[..., 2] > 0)
    depth = torch.where(ahead, x[..., 2], 1.0)
    error = (x[..., :2] / depth[..., None] - observed.xy) / observed.noise[..., None]
    joints = int(observed.joint.max()) + 1
    series = torch.zeros(frames, joints, len(rig.R), 2, dtype=torch.float64)
    there = torch.zeros(frames, joints, len(rig.R), dtype=torch.bool)
    at = (observed.frame, observed.joint)
    series[at] = error.clamp(-_CLIP, _CLIP).transpose(0, 1)
    there[at] = ahead.transpose(0, 1)
    both = there[..., None].expand_as(series)
    return series.flatten(1), both.flatten(1)


@dataclass(frozen=True)
class Turning:
    """Which way people face."""

    degrees: float
    """By how much they turn in all: the range of headings, at most 360."""
    sector: Int[Tensor, " R"]
    """The sector that each row faces, from 0."""

    @property
    def sectors(self) -> int:
        """The number of sectors."""
        return int(self.sector.max()) + 1 if len(self.sector) else 0


def turning(points: Float[Tensor, "R 17 3"], estimated: Bool[Tensor, "R 17"]) -> Turning:
    """Return which way each of R people in frames faces, from the lines from right to left through
    shoulders and hips.

    Headings are angles about the direction in which those lines vary least. A row whose sides are
    not known faces where the one before did.
    """
    left = [pair[0] for pair in _SIDES]
    right = [pair[1] for pair in _SIDES]
    both = (estimated[:, left] & estimated[:, right])[..., None]
    across = torch.where(both, points[:, left] - points[:, right], 0.0).sum(1)
    length = across.norm(dim=-1)
    known = torch.isfinite(length) & (length > 0)
    if not known.any():
        return Turning(0.0, torch.zeros(len(points), dtype=torch.int64))
    unit = across[known] / length[known, None]
    plane = torch.linalg.svd(unit, full_matrices=False)[2][:2]
    mean = plane @ unit.mean(0)
    angle = torch.atan2(*(unit @ plane.T).flip(-1).unbind(-1))
    # counted from the mean heading, so that people who hardly turn lie in one sector
    angle = angle - torch.atan2(mean[1], mean[0])
    angle = torch.rad2deg(torch.remainder(angle + math.pi, 2 * math.pi) - math.pi)
    sector = torch.round(angle / _SECTOR).long().remainder(round(360 / _SECTOR))
    count = torch.bincount(sector)
    # a sector that hardly anybody faces counts with the most frequent one
    sector = torch.where(count[sector] >= _LEAST_SHARE * len(sector), sector, count.argmax())
    ordinal = torch.unique(sector, return_inverse=True)[1]
    rows = torch.arange(len(points))
    before = torch.where(known, rows, -1).cummax(0).values.clamp(min=int(rows[known][0]))
    full = torch.zeros(len(points), dtype=torch.int64)
    full[known] = ordinal
    return Turning(_range(angle), full[before])


@dataclass(frozen=True)
class Evidence:
    """What a recording is worth for its rig."""

    frames: int
    """Frames of the recording."""
    used: int
    """Of which the rig was calibrated from so many."""
    independent: float
    """The number of independent frames that these are worth."""
    turned_deg: float
    """By how much people turn."""
    rotation_sd_deg: float
    """The largest standard deviation of a camera's rotation, the angle about whatever axis."""
    repeatability: float
    """See ``ghpt.calibration.uncertainty.Uncertainty``."""

    def frames_for(self, rotation_sd_deg: float) -> int:
        """Return how many frames like these would give a smaller standard deviation: it falls with
        the square root of their number.
        """
        return math.ceil(self.frames * (self.rotation_sd_deg / rotation_sd_deg) ** 2)


def _range(angle: Float[Tensor, " N"]) -> float:
    """Return the part of the circle, degrees, that headings cover: all but the largest gap."""
    low, high = angle.quantile(torch.tensor([0.05, 0.95], dtype=angle.dtype)).tolist()
    ordered = angle[(angle >= low) & (angle <= high)].sort().values
    if len(ordered) < 2:
        return 0.0
    gaps = torch.cat((ordered.diff(), ordered[:1] + 360.0 - ordered[-1:]))
    return 360.0 - float(gaps.max())
