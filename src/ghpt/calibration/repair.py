"""What would make a camera agree with the others: the mistakes of the catalogue, each undone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.calibration.check.setup import setup_of_intrinsics
from ghpt.calibration.findings import Finding
from ghpt.calibration.mistakes import VIEWS_SWAPPED, Candidate, without_extrinsics
from ghpt.calibration.observations import Correspondences, observe
from ghpt.calibration.pairs import PairTable
from ghpt.calibration.resection import PlacedRig, Resection
from ghpt.errors import check_positive

_SAME_INTRINSICS = 0.01
"""Intrinsics that differ by less are not worth exchanging."""


@dataclass(frozen=True)
class RepairThresholds:
    """When the undoing of a mistake explains why a view does not agree with the others.

    ``share``: least share of the view's key points that agree then. ``ratio``: what the mean of
    their squared errors, cut off at the inlier threshold, is at most of what it was.
    ``exchange_ratio``: the same of two views together whose intrinsics are exchanged.
    """

    share: float
    ratio: float
    exchange_ratio: float

    def __post_init__(self) -> None:
        check_positive(**vars(self))


@dataclass(frozen=True)
class Fit:
    """How well a view fits the people that other views triangulate."""

    cost: float
    """The mean squared error of its key points, cut off at the inlier threshold (1)."""
    share: float
    """The share of its key points that are inliers."""


@dataclass(frozen=True)
class Repair:
    """The search for the mistake that explains why a view does not agree with the others."""

    names: tuple[str, ...]
    K: Float[Tensor, "V 3 3"]
    key_points: Float[Tensor, "T V J 2"]
    valid: Bool[Tensor, "T V J"]
    sizes: Int[Tensor, "V 2"] | None
    """Of the images; None where they are not known."""
    noise: float
    """First guess of the key points' noise, in sizes of the person."""
    table: PairTable
    resection: Resection
    thresholds: RepairThresholds
    seed: int

    def find(self, view: int) -> Finding | None:
        """Return the mistake whose undoing makes the view agree best with the people that the
        others triangulate; None if none does. It takes two other views that can be linked.
        """
        observed = observe(self.K, self.key_points, self.valid, self.noise)
        others = self._others(observed, {view})
        if others is None:
            return None
        limit = self.thresholds.ratio * self._fit(observed, others, view).cost
        best: Finding | None = None
        setup = setup_of_intrinsics(self.K, self.sizes)
        for candidate in without_extrinsics(setup, view):
            fit = self._fit(self._observe(observed, candidate, view), others, view)
            if fit.share >= self.thresholds.share and fit.cost < limit:
                best = self._finding(candidate, fit, view)
                limit = fit.cost
        return best or self._exchange(observed, view)

    def _finding(self, candidate: Candidate, fit: Fit, view: int) -> Finding:
        found = candidate.mistake.finding((self.names[view],), candidate.value)
        return replace(found, text=_with_share(found.text, fit))

    def _observe(
        self, observed: Correspondences, candidate: Candidate, view: int
    ) -> Correspondences:
        """Return the correspondences with the candidate's key points in its view."""
        pixels = self.key_points.clone()
        valid = self.valid.clone()
        own = candidate.setup.transform_as(view, pixels[:, view], valid[:, view])
        pixels[:, view], valid[:, view] = own
        tried = observe(candidate.setup.K, pixels, valid, self.noise)
        return observed.with_view(view, tried)

    def _others(self, observed: Correspondences, without: set[int]) -> PlacedRig | None:
        """Return the rig of the other views alone, which these cannot have spoilt; None where no
        two of them are linked.
        """
        views = range(len(observed.valid))
        table = self.table.among(torch.tensor([view not in without for view in views]))
        if not table.linked.any():
            return None
        expected = torch.where(table.linked, table.expected, torch.inf)
        rig = self.resection.begin(observed, table, int(expected.argmin()), self.seed)
        return self.resection.grow(observed, table, rig, self.seed)

    def _fit(self, observed: Correspondences, others: PlacedRig, view: int) -> Fit:
        pose = self.resection.place(observed, others, view, self.seed)
        known = observed.valid[view] & others.inlier.any(0)
        if pose is None or not known.any():
            return Fit(1.0, 0.0)
        R = others.R.clone()
        t = others.t.clone()
        R[view], t[view] = pose
        error = observed.error(R, t, others.points)[view][known] / self.resection.threshold
        cost = float(error.square().clamp(max=1).mean())
        return Fit(cost, float((error <= 1).double().mean()))

    def _exchange(self, observed: Correspondences, view: int) -> Finding | None:
        """Return whether the view and another have each other's intrinsics.

        Both are judged together against the rest, because each spoils what judges the other.
        """
        for other in range(len(self.names)):
            if not self._may_exchange(view, other):
                continue
            others = self._others(observed, {view, other})
            if others is None:
                continue
            K = self.K.clone()
            K[[view, other]] = self.K[[other, view]]
            tried = observe(K, self.key_points, self.valid, self.noise)
            before = [self._fit(observed, others, v) for v in (view, other)]
            after = [self._fit(tried, others, v) for v in (view, other)]
            worst = min(after, key=lambda fit: fit.share)
            ratio = self.thresholds.exchange_ratio
            if worst.share >= self.thresholds.share and _cost(after) < ratio * _cost(before):
                found = VIEWS_SWAPPED.finding((self.names[view], self.names[other]))
                return replace(found, text=_with_share(found.text, worst))
        return None

    def _may_exchange(self, view: int, other: int) -> bool:
        both = self.K[[view, other]]
        focal = both.diagonal(dim1=-2, dim2=-1)
        intact = bool(torch.isfinite(both).all() & (focal > 0).all())
        same = torch.allclose(self.K[other], self.K[view], rtol=_SAME_INTRINSICS)
        return other != view and intact and not same


def _cost(fits: list[Fit]) -> float:
    return sum(fit.cost for fit in fits)


def _with_share(text: str, fit: Fit) -> str:
    return f"{text} ({fit.share:.0%} of its key points then agree)"
