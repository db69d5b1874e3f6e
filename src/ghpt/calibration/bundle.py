"""Bundle adjustment of extrinsics and points with constant intrinsics: Levenberg-Marquardt steps
with the points eliminated.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.calibration.normal_matrix import (
    Linearised,
    NormalEquations,
    Residuals,
    linearise,
    residuals,
)
from ghpt.calibration.observations import Correspondences
from ghpt.calibration.resection import PlacedRig
from ghpt.errors import check_positive
from ghpt.geometry.rotations import vector_to_matrix

_DAMPING = 1e-4
"""At the start: share by which the normal matrix's diagonal is raised."""
_DAMPING_CHANGE = 10.0
_LARGEST_DAMPING = 1e8
_SMALLEST_DAMPING = 1e-9
_SMALLEST_STEP = 0.3
"""Of the tolerance: a step that gains less of the cost is the last."""


@dataclass(frozen=True)
class Adjusted:
    """A rig after bundle adjustment, and what was verified of it."""

    rig: PlacedRig
    start_cost: float
    final: Linearised
    """At the rig's state."""
    iterations: int
    seconds: float
    converged: bool
    """Finite, in front of every camera, cost not above the start's, and what a Newton step could
    still gain at most ``tolerance`` of the cost.
    """


@dataclass(frozen=True)
class BundleAdjustment:
    """Cauchy loss of scale ``loss_scale`` (units of noise); at most ``iterations`` steps and
    ``seconds``; ``tolerance``: see ``Adjusted.converged``.
    """

    loss_scale: float
    iterations: int
    seconds: float
    tolerance: float

    def __post_init__(self) -> None:
        check_positive(loss_scale=self.loss_scale, iterations=self.iterations, seconds=self.seconds)
        check_positive(tolerance=self.tolerance)

    def __call__(self, observed: Correspondences, rig: PlacedRig) -> Adjusted:
        """Adjust the rig's placed views and its points to their inliers. Never raises on values; a
        rig that could not be improved comes back as it was, with ``converged`` False where it is
        not at a minimum.
        """
        started = time.monotonic()
        used = rig.inlier
        rig = replace(rig, points=torch.where(used.any(0)[:, None], rig.points, 0.0))
        start = self.state(observed, rig)
        solved = rig
        steps = 0
        if start.finite:
            solved, steps = self._solve(observed, rig, used, started + self.seconds)
        final = self.state(observed, solved)
        if not (final.finite and final.cost <= start.cost * (1 + 1e-12)):
            solved = rig
            final = start
        converged = (
            final.finite
            and final.in_front
            and final.gain <= self.tolerance * max(final.cost, 1e-12 * int(used.sum()))
        )
        seconds = time.monotonic() - started
        return Adjusted(solved, start.cost, final, steps, seconds, bool(converged))

    def state(self, observed: Correspondences, rig: PlacedRig) -> Linearised:
        """Cost and derivatives of a rig as it is."""
        return linearise(observed, rig, rig.inlier, self.loss_scale)

    def _solve(
        self,
        observed: Correspondences,
        rig: PlacedRig,
        used: Bool[Tensor, "V N"],
        until: float,
    ) -> tuple[PlacedRig, int]:
        """Return the adjusted rig, and how many steps were tried."""
        chosen = (used & rig.placed[:, None]).any(0)
        views = torch.nonzero(rig.placed & used.any(1))[:, 0]
        observed = observed.select(chosen).of_views(views)
        now = rig.select(chosen).of_views(views)
        state = self._residuals(observed, now)
        equations = NormalEquations.of(observed, now, state)
        damping = _DAMPING
        steps = 0
        while steps < self.iterations and time.monotonic() < until:
            steps += 1
            reduced = equations.reduce(damping)
            tried = _move(now, *reduced.step())
            then = self._residuals(observed, tried)
            if not then.cost < state.cost:
                damping *= _DAMPING_CHANGE
                if damping > _LARGEST_DAMPING:
                    break
                continue
            gained = state.cost - then.cost
            now = tried
            state = then
            damping = max(damping / _DAMPING_CHANGE, _SMALLEST_DAMPING)
            if gained <= _SMALLEST_STEP * self.tolerance * state.cost:
                break
            equations = NormalEquations.of(observed, now, state)
        R = rig.R.clone()
        t = rig.t.clone()
        points = rig.points.clone()
        R[views] = now.R
        t[views] = now.t
        points[chosen] = now.points
        return replace(rig, R=R, t=t, points=points), steps

    def _residuals(self, observed: Correspondences, rig: PlacedRig) -> Residuals:
        return residuals(observed, rig, rig.inlier, self.loss_scale)


def _move(rig: PlacedRig, views: Float[Tensor, "V 6"], points: Float[Tensor, "N 3"]) -> PlacedRig:
    """Return the rig after a step of the views' and the points' parameters."""
    R = rig.R @ vector_to_matrix(views[:, :3]).mT
    centre = rig.centre + views[:, 3:]
    t = -(R @ centre[..., None])[..., 0]
    return replace(rig, R=R, t=t, points=rig.points + points)
