"""Normal equations of a rig under the robust loss, with the points eliminated (Schur complement).

Parameters of a view are a rotation vector w (radians, ``R exp([w]x)^T``: a turn of the camera about
the world's axes) and its centre c (world); of a point, its coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.calibration.observations import Correspondences
from ghpt.calibration.resection import PlacedRig
from ghpt.geometry.normal_equations import minors

BEHIND = 1e4
"""Units of noise that an observation behind its camera counts as."""
_LARGEST = 1e100
"""Numbers beyond it are none: their squares would not be finite."""
_SINGULAR = 1e-18
"""Determinant of a point's matrix of trace 1 below which its rays do not fix it."""


@dataclass(frozen=True)
class Residuals:
    """Of the used observations of N points in V views, in units of noise."""

    in_camera: Float[Tensor, "V N 3"]
    """The points in the cameras' frames; depth 1 where not in front."""
    error: Float[Tensor, "V N 2"]
    """0 where not used or not in front."""
    weight: Float[Tensor, "V N"]
    """Of the Cauchy loss; 0 where not used or not in front."""
    cost: float
    """Sum of the Cauchy loss c^2 / 2 log(1 + r^2 / c^2) over the used observations."""
    in_front: bool
    """Whether all used observations are."""


def residuals(
    observed: Correspondences, rig: PlacedRig, used: Bool[Tensor, "V N"], scale: float
) -> Residuals:
    """Return the errors of a rig; ``scale``: of the Cauchy loss, units of noise."""
    in_camera = rig.points @ rig.R.mT + rig.t[:, None]
    depth = in_camera[..., 2]
    front = used & (depth > 0)
    depth = torch.where(front, depth, 1.0)
    in_camera = torch.cat((in_camera[..., :2], depth[..., None]), dim=-1)
    error = (in_camera[..., :2] / depth[..., None] - observed.xy) / observed.noise[..., None]
    error = torch.where(front[..., None], error, 0.0)
    square = error.square().sum(-1)
    behind = float((used & ~front).sum())
    ratio = square / scale**2
    loss = float(torch.log1p(ratio).sum()) + behind * float(
        torch.log1p(torch.tensor((BEHIND / scale) ** 2, dtype=torch.float64))
    )
    weight = torch.where(front, 1 / (1 + ratio), 0.0)
    return Residuals(in_camera, error, weight, scale**2 / 2 * loss, behind == 0)


@dataclass(frozen=True)
class Derivatives:
    """Of the weighted errors of N points in V views."""

    root: Float[Tensor, "V N"]
    """Square root of the weight, which the others contain."""
    by_view: Float[Tensor, "V N 2 A"]
    by_point: Float[Tensor, "V N 2 3"]

    @classmethod
    def of(cls, observed: Correspondences, rig: PlacedRig, now: Residuals) -> Derivatives:
        """Return the derivatives of a rig with these residuals."""
        root = now.weight.sqrt()
        scale = root / (observed.noise * now.in_camera[..., 2])
        slope = now.in_camera[..., :2] / now.in_camera[..., 2:]
        R = rig.R[:, None]
        # the derivatives by the point: f / z (r_1 - x / z r_3), and the same with r_2 and y
        by_point = R[..., :2, :] - slope[..., None] * R[..., 2:, :]
        by_point = scale[..., None, None] * by_point
        arm = (rig.points - rig.centre[:, None])[..., None, :].expand_as(by_point)
        by_view = torch.cat((torch.linalg.cross(by_point, arm), -by_point), dim=-1)
        return cls(root, by_view, by_point)


@dataclass(frozen=True)
class NormalEquations:
    """Normal matrix and gradient of V views and N points."""

    views: Float[Tensor, "V 6 6"]
    cross: Float[Tensor, "N P 3"]
    """Of the P = 6 V parameters of the views with each point's."""
    points: Float[Tensor, "N 3 3"]
    views_gradient: Float[Tensor, "N P"]
    """Of each point's cost."""
    points_gradient: Float[Tensor, "N 3"]

    @classmethod
    def of(cls, observed: Correspondences, rig: PlacedRig, now: Residuals) -> NormalEquations:
        """Return the equations of a rig with these residuals."""
        slopes = Derivatives.of(observed, rig, now)
        error = slopes.root[..., None] * now.error
        by_view = slopes.by_view
        by_point = slopes.by_point
        rows = by_view.flatten(1, 2)
        return cls(
            views=rows.mT @ rows,
            cross=_outer_sum(by_view, by_point).transpose(0, 1).flatten(1, 2),
            points=_outer_sum(by_point, by_point).sum(0),
            views_gradient=_weighted_sum(by_view, error).transpose(0, 1).flatten(1),
            points_gradient=_weighted_sum(by_point, error).sum(0),
        )

    def reduce(self, damping: float = 0.0) -> ReducedEquations:
        """Return the equations of the views alone.

        ``damping``: share by which the diagonals of views and points are raised.
        """
        inverse, solvable = _inverse(self.points, damping)
        eliminated = self.cross @ inverse
        gradient = (eliminated @ self.points_gradient[..., None])[..., 0]
        return ReducedEquations(
            equations=self,
            inverse=inverse,
            eliminated=eliminated,
            gradient=self.views_gradient - gradient,
            solvable=bool(solvable.all()),
            damping=damping,
        )


@dataclass(frozen=True)
class ReducedEquations:
    """Normal equations with the points eliminated."""

    equations: NormalEquations
    inverse: Float[Tensor, "N 3 3"]
    """Of the points' matrices; 0 where a point's rays do not fix it."""
    eliminated: Float[Tensor, "N P 3"]
    gradient: Float[Tensor, "N P"]
    """Of each point's cost by the views."""
    solvable: bool
    """Whether all points' rays fix them."""
    damping: float

    def matrix(self) -> Float[Tensor, "P P"]:
        """Return the matrix of the P = 6 V parameters, undamped."""
        left = self.eliminated.transpose(1, 2).flatten(0, 1)
        right = self.equations.cross.transpose(1, 2).flatten(0, 1)
        matrix = torch.block_diag(*self.equations.views) - left.T @ right
        return (matrix + matrix.T) / 2

    def step(self) -> tuple[Float[Tensor, "V 6"], Float[Tensor, "N 3"]]:
        """Return the (damped) Gauss-Newton step of views and points."""
        matrix = self.matrix()
        diagonal = self.equations.views.diagonal(dim1=-2, dim2=-1).flatten()
        gradient = self.gradient.sum(0)
        scale = torch.where(diagonal > 0, diagonal.clamp_min(1e-300).rsqrt(), 0.0)
        # scaled to a diagonal of about 1, so that radians and lengths compare
        scaled = matrix * scale * scale[:, None]
        scaled.diagonal().add_(max(self.damping, 1e-12))
        factor, failed = torch.linalg.cholesky_ex(scaled)
        if int(failed):
            nothing = torch.full_like(self.equations.views[:, 0], torch.nan)
            return nothing, self.equations.points_gradient
        solved = torch.cholesky_solve((scale * gradient)[:, None], factor)[:, 0]
        views = -scale * solved
        right = self.equations.points_gradient + views @ self.equations.cross
        return views.unflatten(0, (-1, 6)), -(self.inverse @ right[..., None])[..., 0]

    def gain(self) -> float:
        """Return what the step would gain: half the squared length of the gradient in the inverse
        normal matrix. It is 0 at a minimum and the same in any gauge and unit.
        """
        by_point = (self.inverse @ self.equations.points_gradient[..., None])[..., 0]
        of_points = float((self.equations.points_gradient * by_point).sum() / 2)
        return of_points + _gain(self.matrix(), self.gradient.sum(0))


@dataclass(frozen=True)
class Linearised:
    """A rig's state, and the equations of its views."""

    scale: float
    """Of the Cauchy loss, units of noise."""
    cost: float
    """See `Residuals`."""
    finite: bool
    in_front: bool
    gain: float
    """See `ReducedEquations`."""
    matrix: Float[Tensor, "P P"]
    """Normal matrix of the P = 6 V parameters of the views, points eliminated; singular along the
    gauge's 7.
    """
    scores: Float[Tensor, "T P"]
    """Gradient of each frame's cost by the views' parameters, points eliminated."""


def linearise(
    observed: Correspondences, rig: PlacedRig, used: Bool[Tensor, "V N"], scale: float
) -> Linearised:
    """Return a rig's state. Not finite numbers give ``finite`` False and zeros.

    ``scale``: of the Cauchy loss, units of noise.
    """
    used = used & rig.placed[:, None]
    chosen = used.any(0)
    parameters = 6 * len(rig.R)
    scores = torch.zeros(observed.frames, parameters, dtype=torch.float64)
    infinite = float("inf")
    nothing = Linearised(
        scale=scale,
        cost=infinite,
        finite=False,
        in_front=False,
        gain=infinite,
        matrix=torch.zeros(parameters, parameters, dtype=torch.float64),
        scores=scores,
    )
    if not chosen.any() or not all_finite(observed, rig, used):
        return nothing
    observed = observed.select(chosen)
    rig = rig.select(chosen)
    now = residuals(observed, rig, used[:, chosen], scale)
    reduced = NormalEquations.of(observed, rig, now).reduce()
    scores = scores.index_add(0, observed.frame, reduced.gradient)
    matrix = reduced.matrix()
    if not (torch.isfinite(matrix).all() and torch.isfinite(scores).all()):
        return nothing
    gain = reduced.gain()
    return Linearised(
        scale=scale,
        cost=now.cost,
        finite=gain < infinite,
        in_front=now.in_front and reduced.solvable,
        gain=gain,
        matrix=matrix,
        scores=scores,
    )


def all_finite(observed: Correspondences, rig: PlacedRig, used: Bool[Tensor, "V N"]) -> bool:
    """Return whether the numbers of the placed views and used points can be calculated with."""
    numbers = (
        rig.R[rig.placed],
        rig.t[rig.placed],
        rig.points[used.any(0)],
        observed.xy[used],
    )
    return all(bool((x.abs() < _LARGEST).all()) for x in numbers)


def _outer_sum(a: Float[Tensor, "V N 2 A"], b: Float[Tensor, "V N 2 B"]) -> Tensor:
    """Return the sum over both rows of their outer products, [V N A B]."""
    first = a[:, :, 0, :, None] * b[:, :, 0, None]
    return torch.addcmul(first, a[:, :, 1, :, None], b[:, :, 1, None])


def _weighted_sum(rows: Float[Tensor, "V N 2 A"], error: Float[Tensor, "V N 2"]) -> Tensor:
    """Return the sum of both rows, each times its error, [V N A]."""
    first = rows[:, :, 0] * error[..., :1]
    return torch.addcmul(first, rows[:, :, 1], error[..., 1:])


def _inverse(
    matrix: Float[Tensor, "N 3 3"], damping: float
) -> tuple[Float[Tensor, "N 3 3"], Bool[Tensor, " N"]]:
    """Return inverses, with the diagonal raised; 0 where a point's rays do not fix it."""
    trace = matrix.diagonal(dim1=-2, dim2=-1).sum(-1)
    safe = torch.where(trace > 0, trace, 1.0)
    scaled = matrix / safe[:, None, None]
    diagonal = scaled.diagonal(dim1=-2, dim2=-1)
    scaled = scaled + torch.diag_embed(damping * diagonal)
    xx, xy, xz, _, yy, yz, _, _, zz = scaled.flatten(1).unbind(-1)
    cofactors = minors((xx, xy, xz, yy, yz, zz))
    cxx, cxy, cxz, cyy, cyz, czz = cofactors
    determinant = xx * cxx + xy * cxy + xz * cxz
    solvable = (trace > 0) & (determinant > _SINGULAR)
    factor = torch.where(solvable, 1 / (torch.where(solvable, determinant, 1.0) * safe), 0.0)
    rows = torch.stack((cxx, cxy, cxz, cxy, cyy, cyz, cxz, cyz, czz), dim=-1)
    return factor[:, None, None] * rows.unflatten(-1, (3, 3)), solvable


def precondition(
    matrix: Float[Tensor, "P P"],
) -> tuple[Float[Tensor, " P"], Float[Tensor, " P"], Float[Tensor, "P P"]]:
    """Return 1 / sqrt of the diagonal (0 where it is 0), and eigenvalues and -vectors of the matrix
    scaled to diagonal 1: so radians and lengths compare.
    """
    diagonal = matrix.diagonal()
    scale = torch.where(diagonal > 0, diagonal.clamp_min(1e-300).rsqrt(), 0.0)
    values, vectors = torch.linalg.eigh(matrix * scale * scale[:, None])
    return scale, values, vectors


def _gain(matrix: Float[Tensor, "P P"], gradient: Float[Tensor, " P"]) -> float:
    if not (torch.isfinite(matrix).all() and torch.isfinite(gradient).all()):
        return float("inf")
    scale, values, vectors = precondition(matrix)
    along = vectors.T @ (scale * gradient)
    known = values > 1e-10 * values[-1].clamp_min(1e-300)
    return float((along[known] ** 2 / values[known]).sum() / 2)
