"""Parts of a frame: shifts of calibrated views refined by what a small shift changes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.calibration.time.shifts import TRUNCATION, in_sizes
from ghpt.calibration.time.timeline import Timeline
from ghpt.geometry.epipolar import homogeneous

_LEAST_SCALE = 0.008
"""Of the Cauchy loss, sizes of the person; it is 1.5 times the residuals' median else."""
_STEP = 1.0
"""Frames: the slope of the cost is its difference over this to both sides. A derivative of noisy
key points would take the noise's speed for motion; over a whole frame interpolation, which lessens
noise, is of the same part of a frame.
"""
_MOST = 1.0
"""Frames by which one step changes a shift at most."""
_FARTHEST = 2.0
"""Frames by which all steps together do."""
_ROUNDS = 8
_CONVERGED = 0.02
"""Frames: a step that is smaller is the last one."""


@dataclass(frozen=True)
class PairResiduals:
    """How well pairs of calibrated views fit at given shifts.

    ``blocks``: of time, by which the uncertainty is told. ``centred``: frames over which a pair's
    and joint's median is subtracted, a second or so.
    """

    timeline: Timeline
    E: Float[Tensor, "P 3 3"]
    views: Int[Tensor, "P 2"]
    blocks: int
    centred: int

    def residuals(
        self, shift: Float[Tensor, " V"], extra: float
    ) -> tuple[Float[Tensor, "P N J"], Bool[Tensor, "P N J"]]:
        """Return the residuals in sizes of the person, less their local medians, and which exist.

        ``extra``: frames by which the second view of each pair is taken later.
        """
        residual, both = self._sampson(shift, extra)
        return self._centre(residual, both), both

    def _sampson(
        self, shift: Float[Tensor, " V"], extra: float
    ) -> tuple[Float[Tensor, "P N J"], Bool[Tensor, "P N J"]]:
        """Return the signed Sampson errors in sizes of the person, and which exist."""
        xy, valid = interpolate_at(self.timeline, shift)
        later, later_valid = interpolate_at(self.timeline, shift + extra) if extra else (xy, valid)
        a, b = self.views.T
        scaled = torch.stack(
            [
                in_sizes(self.E[pair], self.timeline, one, other)
                for pair, (one, other) in enumerate(self.views.tolist())
            ]
        )
        ha = homogeneous(xy[a])
        hb = homogeneous(later[b])
        line = torch.einsum("pij,pnkj->pnki", scaled, ha)
        back = torch.einsum("pij,pnki->pnkj", scaled, hb)
        slope = line[..., :2].square().sum(-1) + back[..., :2].square().sum(-1)
        residual = (line * hb).sum(-1) / slope.clamp(min=1e-30).sqrt()
        return residual, valid[a] & later_valid[b]

    def _centre(
        self, residual: Float[Tensor, "P N J"], both: Bool[Tensor, "P N J"]
    ) -> Float[Tensor, "P N J"]:
        masked = torch.where(both, residual, torch.nan)
        parts = [
            part - part.nanmedian(1, keepdim=True).values
            for part in masked.split(max(2, self.centred), dim=1)
        ]
        return torch.where(both, torch.cat(parts, dim=1), 0.0)

    def block_costs(
        self, shift: Float[Tensor, " V"]
    ) -> tuple[Float[Tensor, "P B"], Float[Tensor, "P B"]]:
        """Return the sums of the truncated residuals of each block, and their numbers."""
        residual, both = self.residuals(shift, 0.0)
        truncated = (residual.abs() / TRUNCATION).clamp(max=1)
        return self._by_block(torch.where(both, truncated, 0.0)), self._by_block(both.double())

    def quadratic(
        self, shift: Float[Tensor, " V"], scale: Float[Tensor, "P 1 1"]
    ) -> tuple[Float[Tensor, "P B"], Float[Tensor, "P B"]]:
        """Return the slope and the curvature of the robust cost of each pair and block by a shift
        of the second view.
        """
        before, valid_before = self.residuals(shift, -_STEP)
        now, valid_now = self.residuals(shift, 0.0)
        after, valid_after = self.residuals(shift, _STEP)
        every = valid_before & valid_now & valid_after
        cost = [
            self._by_block(torch.where(every, torch.log1p((residual / scale).square()), 0.0))
            for residual in (before, now, after)
        ]
        slope = (cost[2] - cost[0]) / (2 * _STEP)
        curvature = (cost[2] - 2 * cost[1] + cost[0]) / _STEP**2
        return slope, curvature

    def scale(self, shift: Float[Tensor, " V"]) -> Float[Tensor, "P 1 1"]:
        """Return the scale of the Cauchy loss of each pair."""
        median = _median(*self.residuals(shift, 0.0))
        return (1.5 * median).clamp(min=_LEAST_SCALE)[:, None, None]

    def disagreement(self, shift: Float[Tensor, " V"]) -> Float[Tensor, " P"]:
        """Return the median distance of each pair's key points from their epipolar lines, in sizes
        of the person, with what a camera that is off adds.
        """
        return _median(*self._sampson(shift, 0.0))

    def _by_block(self, values: Float[Tensor, "P N J"]) -> Float[Tensor, "P B"]:
        frames = values.shape[1]
        block = torch.arange(frames) * self.blocks // frames
        total = torch.zeros(len(values), self.blocks, dtype=torch.float64)
        return total.index_add(1, block, values.sum(-1))


def _median(residual: Float[Tensor, "P N J"], both: Bool[Tensor, "P N J"]) -> Float[Tensor, " P"]:
    masked = torch.where(both, residual.abs(), torch.nan).flatten(1)
    return masked.nanmedian(-1).values.nan_to_num(TRUNCATION)


def interpolate_at(
    timeline: Timeline, shift: Float[Tensor, " V"]
) -> tuple[Float[Tensor, "V N J 2"], Bool[Tensor, "V N J"]]:
    """Return the views' key points at their frames n + shift, linearly interpolated, and which
    exist: those both of whose neighbours do.
    """
    floor = shift.floor()
    part = (shift - floor)[:, None, None]
    at = torch.arange(timeline.frames) + floor.long()[:, None]
    xy_before, valid_before = _frames(timeline, at)
    xy_after, valid_after = _frames(timeline, at + 1)
    xy = (1 - part[..., None]) * xy_before + part[..., None] * xy_after
    valid = valid_before & (valid_after | (part == 0))
    return torch.where(valid[..., None], xy, 0.0), valid


def _frames(
    timeline: Timeline, at: Int[Tensor, "V N"]
) -> tuple[Float[Tensor, "V N J 2"], Bool[Tensor, "V N J"]]:
    inside = (at >= 0) & (at < timeline.frames)
    rows = torch.where(inside, at, 0)
    view = torch.arange(len(at))[:, None]
    return timeline.xy[view, rows], timeline.valid[view, rows] & inside[..., None]


@dataclass(frozen=True)
class Refined:
    """Shifts with parts of a frame."""

    shift: Float[Tensor, " V"]
    """Frames, with the mean of those that were given."""
    std: Float[Tensor, " V"]
    """Standard deviation of each shift against the mean of all, by a delete-a-block jackknife; inf
    where the cost has no minimum.
    """


def refine(
    pairs: PairResiduals, start: Float[Tensor, " V"], refined: Bool[Tensor, " V"]
) -> Refined:
    """Return the shifts of least robust cost near the given ones, of the views ``refined``; the
    others do not count.
    """
    a, b = pairs.views.T
    used = refined[a] & refined[b]
    incidence = torch.zeros(len(a), len(start), dtype=torch.float64)
    incidence[torch.arange(len(a)), a] = -1.0
    incidence[torch.arange(len(a)), b] = 1.0
    incidence = incidence * used[:, None]
    scale = pairs.scale(start)
    shift = start
    step = None
    for _ in range(_ROUNDS):
        slope, curvature = pairs.quadratic(shift, scale)
        step = newton_step(incidence, slope.sum(-1), curvature.sum(-1))
        if step is None or float((shift + step - start).abs().max()) > _FARTHEST:
            return Refined(start, torch.full_like(start, torch.inf))
        if float(step.abs().max()) < _CONVERGED:
            break
        shift = shift + step
    return Refined(shift, _jackknife(incidence, slope, curvature))


def _jackknife(
    incidence: Float[Tensor, "P V"],
    slope: Float[Tensor, "P B"],
    curvature: Float[Tensor, "P B"],
) -> Float[Tensor, " V"]:
    """Return standard deviations from what leaving out each block of time changes."""
    count = slope.shape[1]
    samples = []
    for block in range(count):
        kept = torch.arange(count) != block
        step = newton_step(incidence, slope[:, kept].sum(-1), curvature[:, kept].sum(-1))
        if step is None:
            return torch.full((incidence.shape[1],), torch.inf, dtype=torch.float64)
        samples.append(step)
    sample = torch.stack(samples)
    return ((sample - sample.mean(0)).square().mean(0) * (count - 1)).sqrt()


def newton_step(
    incidence: Float[Tensor, "P V"], slope: Float[Tensor, " P"], curvature: Float[Tensor, " P"]
) -> Float[Tensor, " V"] | None:
    """Return the change of the views' shifts, with the mean 0, to the minimum of the pairs'
    parabolas; None where they have none.
    """
    hessian = incidence.mT @ (curvature[:, None] * incidence)
    gradient = incidence.mT @ slope
    views = torch.nonzero(incidence.abs().sum(0))[:, 0]
    values, vectors = torch.linalg.eigh(hessian[views][:, views])
    # one direction, all shifts alike, changes nothing
    if len(views) < 2 or float(values[1]) <= 1e-9 * float(values[-1]) or float(values[0]) < -1e-6:
        return None
    along = vectors[:, 1:].mT @ gradient[views]
    step = torch.zeros_like(gradient)
    step[views] = -vectors[:, 1:] @ (along / values[1:])
    return step.clamp(-_MOST, _MOST)
