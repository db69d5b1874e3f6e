"""What is known of people who move: accelerations are bounded, and bones keep their lengths."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from torch import Tensor

from ghpt.errors import check, check_positive
from ghpt.models.estimators.trajectory.normal_matrix import UPPER, TimeCoupling

NOMINAL_RATE = 50.0
"""Hz. Settings of motion are given at this rate; a recording of unknown rate is taken to have it.
"""
_LEAST_FRAMES = 10
"""Frames with both ends of a bone, without which its length is unknown."""


@dataclass(frozen=True)
class TimeAxis:
    """T frames at equal distances."""

    rate_hz: float
    joined: Bool[Tensor, " T"]
    """Whether a frame and the next one are of one piece; False for the last."""

    @property
    def scale(self) -> float:
        """The length of a frame in frames of the nominal rate."""
        return NOMINAL_RATE / self.rate_hz

    def frames(self, seconds: float) -> int:
        """Return a time in frames, rounded."""
        return round(seconds * self.rate_hz)


@dataclass(frozen=True)
class MotionPrior:
    """Accelerations are normally distributed with a deviation that follows the motion itself.

    The deviation of a joint's second difference is ``factor`` times the root mean square of the
    current estimate's around the frame (a Gaussian window of ``window_s``), between ``least`` and
    ``most`` mm; ``first`` before there is an estimate. ``speed``: deviation of the first difference
    (mm), which counts where no view sees the joint: an acceleration prior alone would go on in a
    straight line there. All at 50 Hz.
    """

    factor: float
    window_s: float
    least: float
    most: float
    first: float
    speed: float

    def __post_init__(self) -> None:
        check_positive(**{name: getattr(self, name) for name in self.__annotations__})
        check(self.least <= self.most, "least", "is above most", "Exchange them.")

    def initial(
        self, start: Float[Tensor, "3 J T"], sure: Bool[Tensor, "J T"], axis: TimeAxis
    ) -> Float[Tensor, "J T"]:
        """Return the deviation of second differences before there is an estimate, mm.

        ``start``: single frames' points, of which those count that are ``sure``. Where most of
        these jump, the recording has been cut or the person has been thrown: there the deviation is
        that jump.
        """
        known = sure[:, :-2] & sure[:, 1:-1] & sure[:, 2:]
        inside = _inside(axis.joined)[1:-1] & known
        length = torch.linalg.vector_norm(start.diff(n=2, dim=-1), dim=0)
        jump = torch.zeros_like(axis.joined, dtype=torch.float64)
        jump[1:-1] = torch.where(inside, length, torch.nan).nanmedian(0).values.nan_to_num(0.0)
        usual = jump[jump > 0]
        limit = _JUMP * float(usual.median()) if len(usual) else 0.0
        deviation = torch.full_like(jump, self.first * axis.scale**2)
        deviation = torch.where(jump > limit, torch.maximum(deviation, jump), deviation)
        return deviation.expand(sure.shape).clone()

    def adapt(self, points: Float[Tensor, "3 J T"], axis: TimeAxis) -> Float[Tensor, "J T"]:
        """Return the deviation of second differences around each frame of an estimate, mm."""
        square = torch.zeros_like(points[0])
        square[:, 1:-1] = points.diff(n=2, dim=-1).square().mean(0)
        square *= _inside(axis.joined)
        mean = _smooth(square, self.window_s * axis.rate_hz)
        deviation = self.factor * mean.clamp(min=0).sqrt()
        unit = axis.scale**2
        return deviation.clamp(self.least * unit, self.most * unit)

    def coupling(
        self, deviation: Float[Tensor, "J T"], seen: Bool[Tensor, "J T"], axis: TimeAxis
    ) -> TimeCoupling:
        """Return what ties joints to themselves through time.

        ``seen``: whether any view sees the joint in the frame.
        """
        second = (1 / deviation.square() * _inside(axis.joined))[:, 1:-1]
        unseen = ~seen
        unseen[:, :-1] |= ~seen[:, 1:]
        weak = 1 / (self.speed * axis.scale) ** 2
        first = weak * (unseen.double() + _TINY) * axis.joined
        own = torch.full_like(deviation, _TINY * weak)
        near = -first
        far = torch.zeros_like(deviation)
        own += first
        own[:, 1:] += first[:, :-1]
        own[:, :-2] += second
        own[:, 1:-1] += 4 * second
        own[:, 2:] += second
        near[:, :-2] -= 2 * second
        near[:, 1:-1] -= 2 * second
        far[:, :-2] += second
        return TimeCoupling(own, near, far)


_JUMP = 4.0
"""Of the usual second difference of the median joint: from there on it is a jump."""
_CHANGE_S = 0.12
"""Deviation of the Gaussian window in which views agree on a bone's length."""
_TINY = 1e-5
"""Of the velocity prior's precision: keeps the matrix of what nobody sees positive definite."""


def _smooth(values: Float[Tensor, "J T"], sigma: float) -> Float[Tensor, "J T"]:
    """Return the mean around each frame, weighted by a Gaussian of so many frames."""
    smooth = gaussian_filter1d(values.numpy(), sigma, axis=-1, mode="nearest", truncate=3.0)
    return torch.from_numpy(smooth)


def _inside(joined: Bool[Tensor, " T"]) -> Bool[Tensor, " T"]:
    """Return which frames have both neighbours."""
    inside = joined.clone()
    inside[1:] &= joined[:-1]
    inside[:1] = False
    return inside


@dataclass(frozen=True)
class BonePrior:
    """Bones have constant lengths.

    A bone's length is the median over the frames in which both of its ends are placed without it,
    the deviation ``factor`` times the (robust) one of these, at least ``least`` mm. It counts only
    within ``reach_s`` of such a frame, and a bone with fewer than 10 of them is free. Where views
    agree on another length, ``change`` deviations away, it is as uncertain as that says.
    """

    factor: float
    least: float
    reach_s: float
    change: float

    def __post_init__(self) -> None:
        check_positive(factor=self.factor, least=self.least, reach_s=self.reach_s)
        check_positive(change=self.change)

    def measure(
        self, lengths: Float[Tensor, "B T"], placed: Bool[Tensor, "B T"]
    ) -> tuple[Float[Tensor, " B"], Float[Tensor, " B"]]:
        """Return the length and its precision (mm^-2) of each bone; 0 where it is free."""
        known = placed.sum(-1) >= _LEAST_FRAMES
        measured = torch.where(placed & known[:, None], lengths, torch.nan)
        length = measured.nanmedian(-1).values
        spread = (measured - length[:, None]).abs().nanmedian(-1).values
        deviation = (self.factor * 1.48 * spread).clamp(min=self.least)
        precision = torch.where(known, 1 / deviation.square(), 0.0)
        return torch.where(known, length, 0.0), precision

    def changes(
        self,
        lengths: Float[Tensor, "B T"],
        sure: Bool[Tensor, "B T"],
        length: Float[Tensor, " B"],
        precision: Float[Tensor, " B"],
        axis: TimeAxis,
    ) -> Float[Tensor, "B T"]:
        """Return the variance of lengths around each frame that is seen without bones, mm^2.

        ``sure``: where enough views agree on both ends. Some bones are none: a spine bends, and a
        hip is not where its neighbours' middle is. 0 where a length is less than ``change``
        deviations from its own.
        """
        sigma = _CHANGE_S * axis.rate_hz
        share = _smooth(sure.double(), sigma)
        offset = _smooth(sure * (lengths - length[:, None]), sigma) / share.clamp(min=1e-6)
        square = offset.square()
        changed = (share > 0.5) & (square * precision[:, None] > self.change**2)
        return torch.where(changed, square, 0.0)

    def near(self, placed: Bool[Tensor, "B T"], axis: TimeAxis) -> Bool[Tensor, "B T"]:
        """Return the frames in which bones count."""
        size = 2 * axis.frames(self.reach_s) + 1
        return torch.from_numpy(maximum_filter1d(placed.numpy(), size, axis=-1))


def bone_equations(
    directions: Float[Tensor, "3 B T"],
    lengths: Float[Tensor, " B"],
    precision: Float[Tensor, "B T"],
    ends: tuple[Int[Tensor, " B"], Int[Tensor, " B"]],
    blocks: Float[Tensor, "6 J T"],
    right: Float[Tensor, "3 J T"],
) -> Float[Tensor, "3 B T"]:
    """Add what bones contribute to each end on its own; return the weighted directions.

    A bone's residual, |x - y| - length, is linear near the current ``directions`` u = (x - y) / |x
    - y|: u . (x - y) - length. Two derivatives of |x - y| across the bone are left out, as
    Gauss and Newton do.
    """
    weighted = precision.sqrt() * directions
    outer = torch.stack([weighted[i] * weighted[k] for i, k in UPPER])
    pull = (precision * lengths[:, None]) * directions
    start, end = ends
    blocks.index_add_(1, start, outer).index_add_(1, end, outer)
    right.index_add_(1, start, pull).index_add_(1, end, -pull)
    return weighted
