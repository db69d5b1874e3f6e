"""The search for the one mistake whose undoing brings the views together most."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ghpt.calibration.check.agreement import (
    LARGEST,
    Agreement,
    agreement,
    all_pairs,
    errors,
    median,
    pair_errors,
)
from ghpt.calibration.check.resection import equivalent_rotation, resect
from ghpt.calibration.check.setup import RayCache, Setup
from ghpt.calibration.mistakes import (
    ALREADY_UNDISTORTED,
    LENS,
    MOVED,
    OUT_OF_SYNC,
    RATES,
    Candidate,
    at_rate,
    exchange_views,
    of_all_views,
    of_one_view,
    shift_view,
)
from ghpt.errors import check, check_positive
from ghpt.models.estimators.classical import MEstimator

_MOVED_MOST = 0.75
"""The quantile of the displacement beyond which a key point is one that a candidate moves most."""
_FEW = 80
"""Key points, a quarter of which gives a median."""
_NO_WORSE = 1.02
"""The largest ratio of the mean error of all views after a mistake is undone to that before."""
_TRIED = 8
"""Candidates that are tried with the people triangulated anew."""
Scored = tuple[float, Candidate]
"""A candidate with the gain that is expected of it."""


@dataclass(frozen=True)
class Thresholds:
    """What the undoing of a mistake must gain; errors are held-out medians in sizes of the person.

    The ratios are what the undoing must leave at most of the error of the views it is about:
    ``discrete`` of a mistake with few possibilities, ``shifted`` of a shift in time, ``lens`` of
    one camera's lens, ``lenses`` of all lenses, ``fitted`` of a camera's pose. ``one_frame`` and
    ``fitted_lens`` multiply the ratio of a shift by one frame and of a lens whose k1 is fitted.
    ``min_gain``: smallest absolute reduction of the error. ``level``: largest error of a view that
    agrees. ``rated``: other frame rates are tried of a view with a larger error. ``pairs``: most
    pairs of views tried. ``estimator``: of the people.
    """

    level: float
    discrete: float
    shifted: float
    one_frame: float
    lens: float
    lenses: float
    fitted_lens: float
    fitted: float
    min_gain: float
    rated: float
    pairs: int
    estimator: MEstimator

    def __post_init__(self) -> None:
        check_positive(level=self.level, rated=self.rated, pairs=self.pairs)
        ratios = {
            "discrete": self.discrete,
            "shifted": self.shifted,
            "one_frame": self.one_frame,
            "lens": self.lens,
            "lenses": self.lenses,
            "fitted_lens": self.fitted_lens,
            "fitted": self.fitted,
        }
        for name, ratio in ratios.items():
            check(0 < ratio < 1, name, f"is {ratio}", "It must lie between 0 and 1.")

    def passes(self, candidate: Candidate, before: float, after: float) -> bool:
        """Return whether the errors before and after say that a mistake was made."""
        ratio = self._largest_ratio(candidate)
        return after <= ratio * before and after <= before - self.min_gain

    def _largest_ratio(self, candidate: Candidate) -> float:
        mistake = candidate.mistake
        if mistake is OUT_OF_SYNC:
            return self.shifted * (self.one_frame if abs(candidate.value) == 1 else 1.0)
        if mistake is ALREADY_UNDISTORTED or mistake is LENS:
            ratio = self.lens if candidate.views else self.lenses
            return ratio * (self.fitted_lens if mistake.fitted else 1.0)
        return self.fitted if mistake.fitted else self.discrete


class Search:
    """The mistakes that may be undone next, in a setup and against the people that it shows."""

    def __init__(
        self,
        cache: RayCache,
        setup: Setup,
        thresholds: Thresholds,
        now: Agreement | None = None,
    ) -> None:
        self.cache = cache
        self.setup = setup
        self.thresholds = thresholds
        self.now = self._agreement(setup) if now is None else now

    def after(self, candidate: Candidate, agreement: Agreement) -> Search:
        """Return the search that goes on with a candidate, whose agreement this is."""
        return Search(self.cache, candidate.setup, self.thresholds, agreement)

    def best(self) -> tuple[Candidate, Agreement] | None:
        """Return the mistake whose undoing gains most, and the agreement then; None if none
        passes.
        """
        promising = sorted(self._promising(), key=_gain_of, reverse=True)
        best = None
        most = 0.0
        for _, candidate in promising[:_TRIED]:
            after = self._agreement(candidate.setup)
            old, new = self._contrast(candidate, after)
            drop = self.now.cost - after.cost
            gain = max(drop, self._gain(candidate, old, new)) * self._prior(candidate)
            passes = self.thresholds.passes(candidate, old, new)
            if passes and after.cost <= _NO_WORSE * self.now.cost and gain > most:
                best = (candidate, after)
                most = gain
        return best

    def _agreement(self, setup: Setup) -> Agreement:
        limits = self.thresholds
        return agreement(self.cache, setup, limits.estimator, limits.level, limits.pairs)

    def _prior(self, candidate: Candidate) -> float:
        """Return a factor that prefers what is not fitted, and one lens to all lenses."""
        if not candidate.mistake.fitted:
            return 1.0
        return self.thresholds.fitted if candidate.views else self.thresholds.fitted**2

    def _promising(self) -> list[Scored]:
        """Return the mistakes that pass against the people as they are."""
        return [*self._of_views(), *self._exchanges(), *self._of_all_views()]

    def _of_all_views(self) -> list[Scored]:
        """Return the three best mistakes of all cameras alike, by the best pair of views."""
        cost = self._pair_cost(self.setup)
        found = [
            (cost - self._pair_cost(candidate.setup), candidate)
            for candidate in of_all_views(self.setup)
        ]
        found.sort(key=_gain_of, reverse=True)
        undistorted = [one for one in found[3:] if one[1].mistake is ALREADY_UNDISTORTED]
        return found[:3] + undistorted

    def _pair_cost(self, setup: Setup) -> float:
        rays = self.cache.all(setup)
        step = max(1, rays.xy.shape[1] // 12)
        pairs = all_pairs(len(setup), self.thresholds.pairs)
        error = pair_errors(rays, setup, pairs, step)
        return float(error.clamp(max=LARGEST).mean(-1).amin())

    def _of_views(self) -> list[Scored]:
        """Return the two best mistakes of each camera."""
        found: list[Scored] = []
        for view in range(len(self.setup)):
            self.cache.prepare(self.setup, view)
            scored = [
                self._score(candidate, view)
                for candidate in self._of_view(view)
                if self._passes_now(candidate)
            ]
            scored.sort(key=_gain_of, reverse=True)
            found += scored[:2]
        return found

    def _of_view(self, view: int) -> list[Candidate]:
        shifts = [shift_view(self.setup, view, by) for by in self._shifts(view)]
        return [
            *of_one_view(self.setup, view),
            *shifts,
            *self._rates(view),
            *self._move(view),
        ]

    def _passes_now(self, candidate: Candidate) -> bool:
        old, new = self._contrast(candidate, self.now)
        return self.thresholds.passes(candidate, old, new)

    def _score(self, candidate: Candidate, view: int) -> Scored:
        old, new = self._contrast(candidate, self.now)
        drop = float(self.now.error[view]) - self._error(candidate.setup, view)
        gain = max(drop / len(self.setup), self._gain(candidate, old, new))
        return gain * (self.thresholds.fitted if candidate.mistake.fitted else 1.0), candidate

    def _shifts(self, view: int) -> list[int]:
        """Return the shifts, other than none, that the evidence can tell, from the present one."""
        largest = self.cache.evidence.max_shift
        present = self.setup.shift[view]
        return [by for by in range(-largest - present, largest - present + 1) if by]

    def _rates(self, view: int) -> list[Candidate]:
        """Return the frame rates to try of a view that does not agree."""
        agrees = float(self.now.error[view]) < self.thresholds.rated
        if self.cache.evidence.at_rate is None or agrees or self.setup.rate[view] != 1:
            return []
        return [at_rate(self.setup, view, ratio) for ratio in RATES]

    def _move(self, view: int) -> list[Candidate]:
        """Return the camera where its key points fit the people that the others see.

        Its value is the rotation in place that would show the same: how much of a camera's new
        pose is rotation and how much is shift is hardly measurable of people far away.
        """
        rays = self.cache.view(self.setup, view)
        points = self.now.points[view]
        known = self.now.known[view]
        found = resect(rays, points, known, LARGEST, 0)
        if found is None:
            return []
        R, t = found
        setup = self.setup
        degrees = equivalent_rotation(rays, points, known, setup.R[view], setup.t[view])
        return [Candidate(MOVED, (view,), setup.replace_camera(view, R=R, t=t), degrees)]

    def _exchanges(self) -> list[Scored]:
        """Return the three best exchanges of two views' key points."""
        views = len(self.setup)
        found = []
        for one, other in all_pairs(views, 1 << 20).tolist():
            candidate = exchange_views(self.setup, one, other)
            new = self._error(candidate.setup, one) + self._error(candidate.setup, other)
            old = float(self.now.error[[one, other]].sum())
            if views <= 3 or self.thresholds.passes(candidate, old / 2, new / 2):
                found.append(((old - new) / views, candidate))
        found.sort(key=_gain_of, reverse=True)
        return found[:3]

    def _error(self, setup: Setup, view: int) -> float:
        """Return a view's error, in another setup, from the people as they are."""
        rays = self.cache.view(setup, view)
        points = self.now.points[view]
        known = self.now.known[view]
        return float(median(errors(rays, setup.R[view], setup.t[view], points, known)))

    def _gain(self, candidate: Candidate, old: float, new: float) -> float:
        views = len(self.setup)
        share = (len(candidate.views) or views) / views
        return 0.25 * (old - new) * share

    def _contrast(self, candidate: Candidate, after: Agreement) -> tuple[float, float]:
        """Return the error of the views that a candidate is about, before and after, over the
        quarter of their key points that it moves most.

        Elsewhere a shift or a lens shows nothing but the detector's noise.
        """
        views = candidate.views or range(len(self.setup))
        pairs = [self._view_contrast(candidate.setup, view, after) for view in views]
        old, new = torch.tensor(pairs, dtype=torch.float64).mean(0).tolist()
        return old, new

    def _view_contrast(self, other: Setup, view: int, after: Agreement) -> tuple[float, float]:
        setup = self.setup
        now = self.now
        old = self.cache.view(setup, view)
        new = self.cache.view(other, view)
        before = errors(old, setup.R[view], setup.t[view], now.points[view], now.known[view])
        then = errors(new, other.R[view], other.t[view], after.points[view], after.known[view])
        both = ~before.isnan() & ~then.isnan()
        if int(both.sum()) < _FEW:  # nothing was triangulated before: there is no common ground
            return float(median(before)), float(median(then))
        size = old.size[:, None].clamp(min=1e-12)
        displacement = (new.xy - old.xy).norm(dim=-1) / size
        both &= displacement >= displacement[both].quantile(_MOVED_MOST)
        masked_before = torch.where(both, before, torch.nan)
        masked_then = torch.where(both, then, torch.nan)
        return float(median(masked_before)), float(median(masked_then))


def _gain_of(scored: Scored) -> float:
    return scored[0]
