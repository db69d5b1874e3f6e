"""What a recording is worth: how long the errors of key points last, and how far people turn."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
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
    axes: Float[Tensor, "R 3 3"]
    """Of each row's body, unit vectors in columns: left, and across it in the plane of turning,
    and the axis of turning.
    """


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
        return Turning(0.0, torch.eye(3, dtype=torch.float64).repeat(len(points), 1, 1))
    rows = torch.arange(len(points))
    before = torch.where(known, rows, -1).cummax(0).values.clamp(min=int(rows[known][0]))
    unit = (across / length[:, None])[before]
    plane = torch.linalg.svd(unit, full_matrices=False)[2]
    forward = torch.linalg.cross(plane[2].expand_as(unit), unit)
    forward = torch.nn.functional.normalize(forward, dim=-1)
    axes = torch.stack((unit, forward, plane[2].expand_as(unit)), dim=-1)
    angle = torch.rad2deg(torch.atan2(unit[known] @ plane[1], unit[known] @ plane[0]))
    return Turning(_range(angle), axes)


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
    lasting: float
    """See ``ghpt.calibration.uncertainty.Uncertainty``."""

    @property
    def least_sd_deg(self) -> float:
        """The standard deviation that however many frames like these would leave."""
        return self.rotation_sd_deg * self.lasting**0.5

    def frames_for(self, rotation_sd_deg: float) -> int | None:
        """Return how many frames like these would give a smaller standard deviation: the part of
        the variance that does not last falls with their number. None if no number would.
        """
        left = rotation_sd_deg**2 - self.least_sd_deg**2
        if left <= 0:
            return None
        falling = self.rotation_sd_deg**2 - self.least_sd_deg**2
        return math.ceil(self.frames * falling / left)


def _range(angle: Float[Tensor, " N"]) -> float:
    """Return the part of the circle, degrees, that headings cover: all but the largest gap."""
    mean = torch.deg2rad(angle)
    mean = torch.rad2deg(torch.atan2(mean.sin().mean(), mean.cos().mean()))
    angle = (angle - mean + 180.0).remainder(360.0) - 180.0
    low, high = angle.quantile(torch.tensor([0.05, 0.95], dtype=angle.dtype)).tolist()
    ordered = angle[(angle >= low) & (angle <= high)].sort().values
    if len(ordered) < 2:
        return 0.0
    gaps = torch.cat((ordered.diff(), ordered[:1] + 360.0 - ordered[-1:]))
    return 360.0 - float(gaps.max())
