"""When the frames of each view were taken, from people who move: rates, starts, parts of a frame.

Views are compared pairwise at all shifts (``shifts``), which needs no two of them to agree already;
what is said is what beats every other shift by more than its blocks of time differ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.calibration.time.shifts import (
    ShiftCosts,
    all_pairs_of,
    best_shifts,
    rival_of,
    shift_costs,
)
from ghpt.calibration.time.subframe import PairResiduals, refine
from ghpt.calibration.time.timeline import Timeline
from ghpt.clock import Clock
from ghpt.errors import check, check_positive
from ghpt.geometry.cameras import Cameras, relative_pose
from ghpt.geometry.epipolar import essential

_ROUNDS = 10
T = TypeVar("T")


@dataclass(frozen=True)
class TimeEstimate:
    """When each view's frames were taken."""

    clock: Clock
    """What is known of it: rate 1 and shift 0 of a view that is not determined, and of one that is
    as synchronised as can be told.
    """
    shift: tuple[float, ...]
    """The most likely shift of each view, determined or not; see `Clock`."""
    std: tuple[float, ...]
    """Its standard deviation, in frames of the rig; inf where parts of a frame cannot be told."""
    distinctness: tuple[float, ...]
    """By how many standard deviations the shift beats every other one."""
    determined: tuple[bool, ...]
    whole: bool
    """Whether views disagree too much for parts of a frame."""

    @classmethod
    def unknown(cls, views: int) -> TimeEstimate:
        """Return what is known of views whose time cannot be told."""
        return cls(
            clock=Clock.synchronised(views),
            shift=(0.0,) * views,
            std=(float("inf"),) * views,
            distinctness=(0.0,) * views,
            determined=(False,) * views,
            whole=False,
        )

    def among(self, views: Sequence[int], count: int) -> TimeEstimate:
        """Return the estimate of ``count`` views of which these ``views`` were estimated."""
        at = {view: row for row, view in enumerate(views)}

        def spread(values: tuple[T, ...], fallback: T) -> tuple[T, ...]:
            return tuple(values[at[v]] if v in at else fallback for v in range(count))

        return TimeEstimate(
            clock=Clock(spread(self.clock.rate, 1.0), spread(self.clock.shift, 0.0)),
            shift=spread(self.shift, 0.0),
            std=spread(self.std, float("inf")),
            distinctness=spread(self.distinctness, 0.0),
            determined=spread(self.determined, False),
            whole=self.whole,
        )

    @property
    def is_synchronised(self) -> bool:
        """Whether nothing says that frames of one number were taken at different times."""
        return self.clock.is_synchronised


@dataclass(frozen=True)
class TimeEstimation:
    """The settings of the estimation of time; lengths are in sizes of the person.

    ``frames``: most frames looked at. ``pairs``: most pairs of views compared. ``anchors``: frames
    of a view that are held against all of another. ``overlap``: least share of the key points that
    a shift compares, of those of the best. ``apart``: frames beyond which a shift is another one.
    ``distinctness``: least z of a shift against every other one and, where it is not 0, against 0.
    ``std``: largest standard deviation of a shift, frames. ``least``: smallest shift that is said,
    frames. ``blocks``: of time, from which uncertainties come. ``rough``: mean distance of the key
    points from their epipolar lines beyond which only whole frames are told, and at least
    ``rough_least`` of them. ``smooth``: frames of the running mean before parts of a frame are
    told. ``centred``: frames over which a residual's median is subtracted. ``rated``: cost (0 to 1)
    beyond which other rates are tried. ``rate_ratio``: largest ratio of the cost with another rate
    to that without.
    """

    frames: int
    pairs: int
    anchors: int
    overlap: float
    apart: int
    distinctness: float
    std: float
    least: float
    blocks: int
    rough: float
    rough_least: float
    smooth: int
    centred: int
    rated: float
    rate_ratio: float

    def __post_init__(self) -> None:
        check_positive(**vars(self))
        check(self.smooth % 2 == 1, "smooth", f"is {self.smooth}", "Give an odd number.")

    @torch.no_grad()
    def __call__(self, timeline: Timeline, cameras: Cameras) -> TimeEstimate:
        """Return when the frames of calibrated views were taken."""
        count = len(timeline.valid)
        if count < 2 or timeline.frames < 2 * self.blocks:
            return TimeEstimate.unknown(count)
        views = all_pairs_of(count, self.pairs)
        E = essential_matrices(cameras, views)
        costs = self._costs(timeline, E, views)
        slow = self._slow_views(timeline, E, costs)
        if not any(slow):
            return self._of_one_rate(timeline, E, costs)
        fast = [not is_slow for is_slow in slow]
        thinned = timeline.thin(fast, 2)
        found = self._of_one_rate(thinned, E, self._costs(thinned, E, views))
        return at_rates(found, slow, timeline.first)

    def _costs(
        self, timeline: Timeline, E: Float[Tensor, "P 3 3"], views: Int[Tensor, "P 2"]
    ) -> ShiftCosts:
        return shift_costs(timeline, E, views, self.anchors, self.overlap)

    def _slow_views(
        self, timeline: Timeline, E: Float[Tensor, "P 3 3"], costs: ShiftCosts
    ) -> tuple[bool, ...]:
        """Return which views have half the frame rate of the others; none where that explains
        little.
        """
        count = len(timeline.valid)
        least = costs.least()
        nobody = (False,) * count
        if float(least.max()) < self.rated:
            return nobody
        # cost of each pair where the first view is slow, where none or both are, or the second
        by_rate = torch.stack((torch.ones_like(least), least, torch.ones_like(least)), dim=-1)
        for pair, (a, b) in enumerate(costs.views.tolist()):
            if float(least[pair]) < self.rated:
                continue
            for column, fast in ((0, b), (2, a)):
                thinned = timeline.thin([view == fast for view in range(count)], 2)
                own = self._costs(thinned, E[pair : pair + 1], costs.views[pair : pair + 1])
                by_rate[pair, column] = own.least()[0]
        choices = {nobody, *(_levels(costs.views, by_rate, view, count) for view in range(count))}
        totals = {choice: _total(costs.views, by_rate, choice) for choice in choices}
        best = min(totals, key=lambda choice: totals[choice])
        return best if totals[best] <= self.rate_ratio * totals[nobody] else nobody

    def _of_one_rate(
        self, timeline: Timeline, E: Float[Tensor, "P 3 3"], costs: ShiftCosts
    ) -> TimeEstimate:
        count = len(timeline.valid)
        whole = best_shifts(costs, count, self.apart, _ROUNDS)
        smoothed = timeline.smooth(self.smooth)
        pairs = PairResiduals(smoothed, E, costs.views, self.blocks, self.centred)
        is_whole = float(pairs.disagreement(whole.double()).mean()) > self.rough
        determined = torch.tensor([bool((costs.views == view).any()) for view in range(count)])
        z = torch.zeros(count, dtype=torch.float64)
        std = torch.full((count,), torch.inf, dtype=torch.float64)
        shift = whole.double()
        while int(determined.sum()) >= 2:
            for view in torch.nonzero(determined)[:, 0].tolist():
                z[view] = self._distinctness(pairs, costs, whole, determined, view)
            fine = refine(pairs, whole.double(), determined)
            std[determined] = fine.std[determined]
            weakness = self.distinctness / z.clamp(min=1e-9)
            if not is_whole:
                shift = torch.where(determined, fine.shift, shift)
                weakness = torch.maximum(weakness, std / self.std)
            weakness = torch.where(determined, weakness, -torch.inf)
            if float(weakness.max()) <= 1:
                break
            determined[int(weakness.argmax())] = False
        if int(determined.sum()) < 2:
            determined[:] = False
        shift = shift - shift[_reference(shift, determined, self.least)]
        least = self.rough_least if is_whole else self.least
        told = self._decidable_shifts(pairs, shift, determined, least)
        ones = (1.0,) * count
        return TimeEstimate(
            clock=Clock(ones, tuple(told.tolist())),
            shift=tuple(shift.tolist()),
            std=tuple(std.tolist()),
            distinctness=tuple(z.tolist()),
            determined=tuple(determined.tolist()),
            whole=is_whole,
        )

    def _distinctness(
        self,
        pairs: PairResiduals,
        costs: ShiftCosts,
        whole: Int[Tensor, " V"],
        determined: Bool[Tensor, " V"],
        view: int,
    ) -> float:
        """Return by how many standard deviations a view's shift beats the best of all others."""
        cost = costs.of_view(view, whole)
        rival = whole.clone()
        rival[view] = rival_of(cost, int(whole[view]) + costs.largest, self.apart) - costs.largest
        others = determined.clone()
        others[view] = True
        return self._contrast(pairs, whole.double(), rival.double(), others, view)

    def _contrast(
        self,
        pairs: PairResiduals,
        shift: Float[Tensor, " V"],
        rival: Float[Tensor, " V"],
        views: Bool[Tensor, " V"],
        view: int,
    ) -> float:
        """Return by how many standard deviations of the blocks of time shifts beat others in the
        pairs of ``view`` with ``views``; 0 where too little is seen of both.
        """
        a, b = pairs.views.T
        own = ((a == view) | (b == view)) & views[a] & views[b]
        cost, count = pairs.block_costs(shift)
        rival_cost, rival_count = pairs.block_costs(rival)
        both = own[:, None] & (count > 0) & (rival_count > 0)
        gain = rival_cost / rival_count.clamp(min=1) - cost / count.clamp(min=1)
        by_block = torch.where(both, gain, torch.nan).nanmean(0)
        known = by_block[~by_block.isnan()]
        if len(known) < self.blocks / 3:
            return 0.0
        error = known.std().clamp(min=1e-12) / len(known) ** 0.5
        return float(known.mean() / error)

    def _decidable_shifts(
        self,
        pairs: PairResiduals,
        shift: Float[Tensor, " V"],
        determined: Bool[Tensor, " V"],
        least: float,
    ) -> Float[Tensor, " V"]:
        """Return the shifts that are large enough to be said and that beat none at all."""
        told = torch.where(determined & (shift.abs() >= least), shift, 0.0)
        for view in torch.nonzero(told)[:, 0].tolist():
            none = told.clone()
            none[view] = 0.0
            if self._contrast(pairs, told, none, determined, view) < self.distinctness:
                told = none
        return told


def essential_matrices(cameras: Cameras, views: Int[Tensor, "P 2"]) -> Float[Tensor, "P 3 3"]:
    """Return the essential matrices of pairs (a, b): ``x_b^T E x_a = 0``."""
    a, b = views.T
    R, t = relative_pose(cameras.R[a], cameras.t[a], cameras.R[b], cameras.t[b])
    length = t.norm(dim=-1, keepdim=True)
    return essential(R, t / torch.where(length > 0, length, 1.0))


def at_rates(found: TimeEstimate, slow: tuple[bool, ...], first: int) -> TimeEstimate:
    """Return an estimate of views thinned to the rate of the slow ones in the frames of the rig,
    which has the rate of most views.

    ``first``: the number of the first frame that was looked at.
    """
    is_rig_fast = 2 * sum(slow) <= len(slow)
    rig = 2.0 if is_rig_fast else 1.0
    own = [1.0 if is_slow else 2.0 for is_slow in slow]
    rate = tuple(frames / rig for frames in own)

    def shifts(thinned: tuple[float, ...]) -> tuple[float, ...]:
        return tuple(
            frames * shift + first * (1 - ratio)
            for frames, shift, ratio in zip(own, thinned, rate, strict=True)
        )

    determined = found.determined
    known = tuple(ratio if known else 1.0 for ratio, known in zip(rate, determined, strict=True))
    told = tuple(
        shift if known else 0.0
        for shift, known in zip(shifts(found.clock.shift), determined, strict=True)
    )
    return TimeEstimate(
        clock=Clock(known, told),
        shift=shifts(found.shift),
        std=tuple(rig * std for std in found.std),
        distinctness=found.distinctness,
        determined=determined,
        whole=found.whole,
    )


def _reference(shift: Float[Tensor, " V"], determined: Bool[Tensor, " V"], near: float) -> int:
    """Return the determined view with whose time most others agree; the first of several."""
    agree = (shift[:, None] - shift).abs() < near
    count = (agree & determined).sum(-1)
    return int(torch.where(determined, count, -1).argmax())


def _levels(
    views: Int[Tensor, "P 2"], by_rate: Float[Tensor, "P 3"], reference: int, count: int
) -> tuple[bool, ...]:
    """Return which views are slow if each view's rate is what its pair with ``reference`` says."""
    level = [0] * count
    for pair, (a, b) in enumerate(views.tolist()):
        first_slower = 1 - int(by_rate[pair].argmin())
        if a == reference:
            level[b] = first_slower
        elif b == reference:
            level[a] = -first_slower
    low = min(level)
    return tuple(each == low for each in level) if max(level) > low else (False,) * count


def _total(
    views: Int[Tensor, "P 2"], by_rate: Float[Tensor, "P 3"], slow: tuple[bool, ...]
) -> float:
    is_slow = torch.tensor(slow).long()
    a, b = views.T
    column = 1 - is_slow[a] + is_slow[b]
    return float(by_rate[torch.arange(len(views)), column].sum())
