"""Shifts by whole frames: every pair of calibrated views at every shift."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.calibration.time.timeline import Timeline
from ghpt.geometry.epipolar import homogeneous

TRUNCATION = 0.05
"""Sizes of the person: a residual that is larger says only that nothing fits."""
_NO_EVIDENCE = 1.0
"""The cost of a shift at which too little is seen by both views: that of residuals which all are
truncated.
"""


@dataclass(frozen=True)
class ShiftCosts:
    """The costs of all shifts of P pairs of views (a, b): frame n of a goes with n + s of b."""

    views: Int[Tensor, "P 2"]
    cost: Float[Tensor, "P S"]
    """Mean truncated residual, 0 to 1, of s = -(N - 1) to N - 1."""

    @property
    def largest(self) -> int:
        """N - 1."""
        return (self.cost.shape[1] - 1) // 2

    def least(self) -> Float[Tensor, " P"]:
        """Return the least cost of each pair."""
        return self.cost.amin(-1)

    def contrast(self, apart: int) -> Float[Tensor, " P"]:
        """Return by how much the best shift of each pair beats those more than ``apart`` frames
        from it.
        """
        best = self.cost.argmin(-1)
        away = _away(best, self.cost.shape[1], apart)
        rival = torch.where(away, self.cost, torch.inf).amin(-1)
        return rival - self.least()

    def of_view(self, view: int, shift: Int[Tensor, " V"]) -> Float[Tensor, " S"]:
        """Return the mean cost of all shifts of one view while the others keep theirs."""
        shifts = torch.arange(-self.largest, self.largest + 1)
        rows = []
        for pair, (a, b) in enumerate(self.views.tolist()):
            if view == b:
                rows.append(self._at(pair, shifts - shift[a]))
            elif view == a:
                rows.append(self._at(pair, shift[b] - shifts))
        return torch.stack(rows).mean(0)

    def _at(self, pair: int, shift: Int[Tensor, " S"]) -> Float[Tensor, " S"]:
        inside = shift.abs() <= self.largest
        index = torch.where(inside, shift, 0) + self.largest
        return torch.where(inside, self.cost[pair, index], _NO_EVIDENCE)


def _away(best: Int[Tensor, "*P"], count: int, apart: int) -> Bool[Tensor, "*P S"]:
    return (torch.arange(count) - best[..., None]).abs() > apart


def rival_of(cost: Float[Tensor, " S"], best: int, apart: int) -> int:
    """Return the index of the least cost more than ``apart`` from ``best``."""
    away = _away(torch.tensor(best), len(cost), apart)
    return int(torch.where(away, cost, torch.inf).argmin())


def all_pairs_of(views: int, most: int) -> Int[Tensor, "P 2"]:
    """Return all pairs of views; of many views each with its next neighbours in number, round and
    round, until there are ``most``.
    """
    pairs = torch.combinations(torch.arange(views), 2)
    if len(pairs) <= most:
        return pairs
    steps = max(1, most // views)
    first = torch.arange(views).repeat(steps)
    second = (first + 1 + torch.arange(steps).repeat_interleave(views)) % views
    return torch.stack((first, second), dim=-1).sort(-1).values.unique(dim=0)


def shift_costs(
    timeline: Timeline,
    E: Float[Tensor, "P 3 3"],
    views: Int[Tensor, "P 2"],
    anchors: int,
    overlap: float,
) -> ShiftCosts:
    """Return the costs of all shifts of the pairs whose essential matrices are given.

    ``anchors``: frames of the one view, evenly spread, that are held against all of the other.
    ``overlap``: least share of the key points that the best shift compares.

    The residual is the signed Sampson error, in sizes of the person, less its median over the
    frames of a joint: what a camera that is not quite where its file has it adds to all frames
    alike must not choose the shift.
    """
    cost = [
        _pair_cost(timeline, E[pair], a, b, anchors, overlap)
        for pair, (a, b) in enumerate(views.tolist())
    ]
    return ShiftCosts(views, torch.stack(cost))


def in_sizes(E: Float[Tensor, "3 3"], timeline: Timeline, a: int, b: int) -> Float[Tensor, "3 3"]:
    """Return the essential matrix of coordinates in sizes of the person."""
    one = torch.ones((), dtype=E.dtype)
    scale_a = torch.stack((timeline.size[a], timeline.size[a], one))
    scale_b = torch.stack((timeline.size[b], timeline.size[b], one))
    return scale_b[:, None] * E * scale_a


def _pair_cost(
    timeline: Timeline, E: Float[Tensor, "3 3"], a: int, b: int, anchors: int, overlap: float
) -> Float[Tensor, " S"]:
    scaled = in_sizes(E, timeline, a, b).float()
    frames = timeline.frames
    seen = torch.nonzero(timeline.valid[a].any(-1))[:, 0]
    spread = torch.linspace(0, len(seen) - 1, min(anchors, len(seen))).round().long()
    rows = seen[spread]
    shifts = torch.arange(-(frames - 1), frames)
    ha = homogeneous(timeline.xy[a, rows].float())
    hb = homogeneous(timeline.xy[b].float())
    line = ha @ scaled.mT
    slope_a = line[..., :2].square().sum(-1)
    slope_b = (hb @ scaled)[..., :2].square().sum(-1)
    numerator = torch.einsum("ijc,kjc->jik", line, hb)
    residual = numerator / (slope_a.mT[..., None] + slope_b.mT[:, None]).sqrt()
    both = timeline.valid[a, rows].mT[..., None] & timeline.valid[b].mT[:, None]
    residual = torch.where(both, residual, torch.nan)
    at = shifts[:, None] + rows
    inside = (at >= 0) & (at < frames)
    index = torch.where(inside, at, 0)
    diagonal = residual[:, torch.arange(len(rows)), index]
    diagonal = torch.where(inside, diagonal, torch.nan)
    return _mean_cost(diagonal, overlap)


def _mean_cost(residual: Float[Tensor, "J S F"], overlap: float) -> Float[Tensor, " S"]:
    known = ~residual.isnan()
    count = known.sum((0, 2))
    if not bool(count.any()):
        return torch.full(count.shape, _NO_EVIDENCE, dtype=torch.float64)
    centred = residual - residual.nanmedian(-1, keepdim=True).values
    truncated = (centred.abs() / TRUNCATION).clamp(max=1)
    total = torch.where(known, truncated, 0.0).sum((0, 2))
    cost = total / count.clamp(min=1)
    return torch.where(count >= overlap * count.max(), cost, _NO_EVIDENCE).double()


def best_shifts(costs: ShiftCosts, views: int, apart: int, rounds: int) -> Int[Tensor, " V"]:
    """Return the shifts of all views of least total cost, from a spanning tree of the most
    distinct pairs on, one view at a time; those of views without a pair are 0.

    They are relative to the first view's.
    """
    shift = _from_tree(costs, views, apart)
    for _ in range(rounds):
        before = shift.clone()
        for view in range(views):
            if bool((costs.views == view).any()):
                cost = costs.of_view(view, shift)
                best = int(cost.argmin())
                if float(cost[best]) < _at_shift(cost, int(shift[view])):
                    shift[view] = best - costs.largest
        if torch.equal(before, shift):
            break
    return shift - shift[0]


def _at_shift(cost: Float[Tensor, " S"], shift: int) -> float:
    largest = (len(cost) - 1) // 2
    return float(cost[shift + largest]) if abs(shift) <= largest else float("inf")


def _from_tree(costs: ShiftCosts, views: int, apart: int) -> Int[Tensor, " V"]:
    shift = torch.zeros(views, dtype=torch.int64)
    best = costs.cost.argmin(-1) - costs.largest
    contrast = costs.contrast(apart)
    reached = torch.zeros(views, dtype=torch.bool)
    reached[0] = True
    for _ in range(views - 1):
        into = reached[costs.views].sum(-1) == 1
        if not bool(into.any()):
            break
        pair = int(torch.where(into, contrast, -torch.inf).argmax())
        a, b = costs.views[pair].tolist()
        if reached[a]:
            shift[b] = shift[a] + best[pair]
        else:
            shift[a] = shift[b] - best[pair]
        reached[[a, b]] = True
    return shift
