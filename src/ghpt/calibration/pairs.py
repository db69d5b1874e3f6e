"""The relative pose of every pair of views, and how well each pair determines it."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import poselib
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.calibration.observations import Correspondences
from ghpt.errors import check_positive
from ghpt.geometry.epipolar import cross_matrix, depths, essential, homogeneous


@dataclass(frozen=True)
class PairTable:
    """The pairs of views (a, b) with an estimate ``x_b = R x_a + t``, |t| = 1: the edges of the
    rig's graph.
    """

    views: Int[Tensor, "P 2"]
    common: Int[Tensor, " P"]
    """Correspondences that both views see."""
    inliers: Int[Tensor, " P"]
    R: Float[Tensor, "P 3 3"]
    t: Float[Tensor, "P 3"]
    expected: Float[Tensor, " P"]
    """Expected error (radians) of R and of t's direction together, at noise of one unit: sqrt tr of
    the inverse normal matrix of the Sampson errors. Two cameras that look at each other have a
    large one.
    """
    angle: Float[Tensor, " P"]
    """Median angle between corresponding rays, radians in [0, pi/2]."""
    linked: Bool[Tensor, " P"]
    """Whether the pair may carry the rig: enough inliers, enough of the common ones."""

    def among(self, views: Bool[Tensor, " V"]) -> PairTable:
        """The pairs of some of the views."""
        inside = views[self.views].all(-1)
        return PairTable(*(getattr(self, field.name)[inside] for field in fields(self)))


def camera_dict(focal: float) -> dict:
    """A view in its own unit, as poselib wants it."""
    return {"model": "SIMPLE_PINHOLE", "width": 1, "height": 1, "params": [focal, 0.0, 0.0]}


def ransac_options(threshold: float, iterations: int, seed: int, kind: str) -> dict:
    return {
        kind: threshold,
        "max_iterations": iterations,
        "min_iterations": min(100, iterations),
        "seed": seed,
    }


@dataclass(frozen=True)
class PairEstimation:
    """The pairs with at least ``least`` common correspondences, by poselib's LO-RANSAC and
    refinement: of each view those with the ``partners`` views that see most of what it sees.

    ``threshold``: largest Sampson error of an inlier, in units of noise. A pair is linked if it has
    ``least`` inliers and they are ``share`` of the common correspondences. ``iterations``: the cap
    of RANSAC. ``points``: of a pair at most so many correspondences, evenly spread.
    """

    threshold: float
    iterations: int
    least: int
    share: float
    partners: int
    points: int

    def __post_init__(self) -> None:
        check_positive(**vars(self))

    def __call__(self, observed: Correspondences, seed: int) -> PairTable:
        found = (self.pair(observed, a, b, seed) for a, b in self._partners(observed.valid))
        rows = [row for row in found if row is not None]
        return (
            PairTable(*map(torch.stack, zip(*rows, strict=True))) if rows else PairTable(*_NOTHING)
        )

    def _partners(self, valid: Bool[Tensor, "V N"]) -> list[tuple[int, int]]:
        """Return the pairs (a, b), a < b, that are estimated, in order."""
        seen = valid.double()
        common = seen @ seen.T
        common.fill_diagonal_(-1.0)
        views = len(valid)
        # among equals the next in the order of the views: so all are linked
        step = torch.arange(views) - torch.arange(views)[:, None]
        common = common - step.remainder(views) / (2 * views)
        best = common.topk(min(self.partners, views - 1), dim=-1).indices
        chosen = torch.zeros(views, views, dtype=torch.bool).scatter_(1, best, True)
        return torch.nonzero((chosen | chosen.T).triu(1)).tolist()

    def pair(
        self, observed: Correspondences, a: int, b: int, seed: int
    ) -> tuple[Tensor, ...] | None:
        """Return two views' row of a `PairTable`; None where they have too little in common."""
        both = observed.valid[a] & observed.valid[b]
        common = int(both.sum())
        if common < self.least:
            return None
        if common > self.points:
            at = torch.nonzero(both)[:, 0]
            spread = torch.linspace(0, common - 1, self.points).round().long()
            both = torch.zeros_like(both).scatter_(0, at[spread], True)
            common = self.points
        focal = [observed.focal(v) for v in (a, b)]
        na = observed.xy[a, both]
        nb = observed.xy[b, both]
        options = ransac_options(self.threshold, self.iterations, seed, "max_epipolar_error")
        pose, info = poselib.estimate_relative_pose(
            (na * focal[0]).numpy(),
            (nb * focal[1]).numpy(),
            *map(camera_dict, focal),
            options,
            {"loss_type": "CAUCHY", "loss_scale": self.threshold / 2},
        )
        R = torch.from_numpy(np.array(pose.R))
        t = torch.from_numpy(np.array(pose.t))
        if not (torch.isfinite(R).all() and torch.isfinite(t).all()) or t.norm() < 1e-9:
            return None
        t = t / t.norm()
        inlier = torch.tensor(info["inliers"], dtype=torch.bool)
        alpha, beta = depths(R, t, na, nb)
        inlier &= (alpha > 0) & (beta > 0)
        count = int(inlier.sum())
        expected, angle = _condition(R, t, na[inlier], nb[inlier], focal)
        linked = (
            count >= self.least and count >= self.share * common and bool(torch.isfinite(expected))
        )
        numbers = torch.tensor([a, b]), torch.tensor(common), torch.tensor(count)
        return *numbers, R, t, expected, angle, torch.tensor(linked)


_NOTHING = (
    torch.zeros(0, 2, dtype=torch.int64),
    torch.zeros(0, dtype=torch.int64),
    torch.zeros(0, dtype=torch.int64),
    torch.zeros(0, 3, 3, dtype=torch.float64),
    torch.zeros(0, 3, dtype=torch.float64),
    torch.zeros(0, dtype=torch.float64),
    torch.zeros(0, dtype=torch.float64),
    torch.zeros(0, dtype=torch.bool),
)


def _condition(
    R: Float[Tensor, "3 3"],
    t: Float[Tensor, " 3"],
    a: Float[Tensor, "N 2"],
    b: Float[Tensor, "N 2"],
    focal: list[float],
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """``PairTable.expected`` and ``angle`` from the inliers (normalised coordinates)."""
    if len(a) < 5:
        return torch.tensor(torch.inf, dtype=a.dtype), torch.tensor(0.0, dtype=a.dtype)
    E = essential(R, t)
    ha = homogeneous(a)
    hb = homogeneous(b)
    # the Sampson error's denominator: unit noise in both images, each with its own focal length
    slope = ((hb @ E)[:, :2] / focal[0]).square().sum(-1) + (
        (ha @ E.mT)[:, :2] / focal[1]
    ).square().sum(-1)
    basis = torch.linalg.svd(t[None])[2][1:]
    turns = cross_matrix(torch.eye(3, dtype=E.dtype))
    moved = torch.cat((E @ turns, cross_matrix(basis) @ R))
    J = torch.einsum("ni,kij,nj->nk", hb, moved, ha) / slope.clamp_min(1e-30).sqrt()[:, None]
    values = torch.linalg.eigvalsh(J.mT @ J)
    expected = torch.where(
        values[0] > 1e-12 * values[-1], (1 / values.clamp_min(1e-300)).sum().sqrt(), torch.inf
    )
    u = ha @ R.mT
    v = hb
    sine = torch.linalg.cross(u, v).norm(dim=-1) / (u.norm(dim=-1) * v.norm(dim=-1))
    return expected, sine.clamp(max=1).asin().median()
