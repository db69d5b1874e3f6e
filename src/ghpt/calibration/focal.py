"""Focal lengths that nobody gave, from the people in view: one robust bundle adjustment over them,
the extrinsics and the points, and what it is worth.

Views see pixels of a first guess of the focal length, ``u = (pixel - image's centre) / f0``, and
the model is ``u = f / f0 (1 + k1 s) p + c`` with ``p = (x, y) / z`` in the camera, ``s = |p|^2``
and the principal point ``c``, which is known beforehand to lie near 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.calibration.error_model import ErrorModel
from ghpt.calibration.independence import turning
from ghpt.calibration.normal_matrix import Derivatives, precondition
from ghpt.calibration.observations import Correspondences
from ghpt.calibration.resection import PlacedRig
from ghpt.calibration.uncertainty import LensErrors, Propagation, curvature, error_steps
from ghpt.errors import check_positive
from ghpt.geometry.cameras import camera_centre
from ghpt.geometry.epipolar import cross_matrix, normalise
from ghpt.geometry.rotations import vector_to_matrix
from ghpt.models.relative_pose.scale import stature

_EXTRINSICS = 6
_FOCAL = 6
_K1 = 7
_CENTRE = 8
"""Places of a view's parameters: rotation and centre, log f, k1, and the principal point."""
_PARAMETERS = 10
_SPREAD = 1.1774
"""Median length of 2D errors over their standard deviation by coordinate (Rayleigh)."""
_OWN = 0.4
"""How much the principal points of a rig's cameras differ from each other, of how far they are off
all alike: 0.5 of 1.2 % of the image in Human3.6M's rig and in Panoptic's.
"""
_LEAST = 1e-12
_DAMPING = (1e-10, 1e10)
_CONVERGED = 1e-6
"""Relative change of the cost."""


class FocalLengths(StrEnum):
    """Which focal lengths are estimated."""

    SHARED = "shared"
    """One for all cameras."""
    EACH = "each"
    """One for each."""


@dataclass(frozen=True)
class View3D:
    """N points that V views see."""

    u: Float[Tensor, "V N 2"]
    """See the module."""
    valid: Bool[Tensor, "V N"]
    frame: Int[Tensor, " N"]
    joint: Int[Tensor, " N"]


@dataclass(frozen=True)
class Lenses:
    """The state of an adjustment."""

    R: Float[Tensor, "V 3 3"]
    centre: Float[Tensor, "V 3"]
    points: Float[Tensor, "N 3"]
    log_ratio: Float[Tensor, " V"]
    """Of f to f0."""
    k1: Float[Tensor, " V"]
    c: Float[Tensor, "V 2"]
    """The principal points, u."""


@dataclass(frozen=True)
class FocalEstimate:
    """Estimated intrinsics."""

    ratio: Float[Tensor, " V"]
    """Of each focal length to the first guess."""
    std: Float[Tensor, " V"]
    """Its relative standard deviation."""
    k1: Float[Tensor, " V"]
    state: Lenses
    """Where the adjustment ended."""


@dataclass(frozen=True)
class FocalAdjustment:
    """The settings of the adjustment.

    ``loss_scale``: of the Cauchy loss, in standard deviations of the key points. ``rounds``:
    adjustments, each with the noise that the one before has shown. ``iterations``: most steps of a
    round. ``draws``: of each kind of error, for the uncertainty. ``principal_point``: what the
    principal points of all cameras may be off by alike, in the longer side of the image; they are
    estimated with that as prior knowledge, which counts ``prior_weight`` times because key points
    are not as independent as their weights say.
    """

    loss_scale: float
    rounds: int
    iterations: int
    draws: int
    principal_point: float
    prior_weight: float

    def __post_init__(self) -> None:
        check_positive(**vars(self))

    @torch.no_grad()
    def __call__(
        self,
        seen: View3D,
        start: Lenses,
        focal: FocalLengths,
        with_k1: bool,
        centre_std: Float[Tensor, " V"],
    ) -> FocalEstimate:
        """Return the focal lengths of all views; ``centre_std``: of their principal points, u."""
        chosen = _selection(len(seen.u), focal, with_k1)
        prior = _prior(centre_std, self.prior_weight)
        noise = torch.ones(len(seen.u), dtype=torch.float64)
        state = start
        for _ in range(self.rounds):
            noise = self._noise(seen, state)
            state = self._minimise(seen, state, noise, chosen, prior)
        std = self._std(seen, state, noise, chosen, centre_std, prior)
        return FocalEstimate(state.log_ratio.exp(), std, state.k1, state)

    def _noise(self, seen: View3D, state: Lenses) -> Float[Tensor, " V"]:
        residual, front = _residual(seen, state)
        length = torch.where(front, residual.norm(dim=-1), torch.nan)
        return (length.nanmedian(-1).values / _SPREAD).nan_to_num(1.0).clamp(min=_LEAST)

    def _cost(
        self,
        seen: View3D,
        state: Lenses,
        noise: Float[Tensor, " V"],
        prior: Float[Tensor, "P P"],
    ) -> float:
        residual, front = _residual(seen, state)
        square = (residual / noise[:, None, None]).square().sum(-1)
        square = torch.where(front, square, torch.where(seen.valid, 1e8, 0.0))
        x = _prior_residual(state)
        of_prior = x @ prior @ x / self.loss_scale**2
        return float(torch.log1p(square / self.loss_scale**2).sum() + of_prior)

    def _minimise(
        self,
        seen: View3D,
        state: Lenses,
        noise: Float[Tensor, " V"],
        chosen: Float[Tensor, "P Q"],
        prior: Float[Tensor, "P P"],
    ) -> Lenses:
        """Return the state of least cost near another, by Levenberg and Marquardt's steps."""
        damping = 1e-3
        cost = self._cost(seen, state, noise, prior)
        for _ in range(self.iterations):
            system = _linearise(seen, state, noise, self.loss_scale)
            matrix, gradient = system.reduce(torch.ones_like(seen.frame, dtype=torch.bool))
            matrix = chosen.mT @ (matrix + prior) @ chosen
            gradient = chosen.mT @ (gradient + prior @ _prior_residual(state))
            while damping < _DAMPING[1]:
                damped = matrix + damping * torch.diag(matrix.diagonal().clamp(min=_LEAST))
                change = chosen @ torch.linalg.solve(damped, -gradient)
                tried = system.step(state, change)
                new_cost = self._cost(seen, tried, noise, prior)
                if new_cost < cost:
                    break
                damping *= 10
            else:
                return state
            gain = (cost - new_cost) / max(cost, _LEAST)
            state = tried
            cost = new_cost
            damping = max(damping / 10, _DAMPING[0])
            if gain < _CONVERGED:
                break
        return state

    def _std(
        self,
        seen: View3D,
        state: Lenses,
        noise: Float[Tensor, " V"],
        chosen: Float[Tensor, "P Q"],
        centre_std: Float[Tensor, " V"],
        prior: Float[Tensor, "P P"],
    ) -> Float[Tensor, " V"]:
        """Return relative standard deviations: what errors like the residuals do, and principal
        points that are not where they were believed to be.
        """
        system = _linearise(seen, state, noise, self.loss_scale)
        views = len(seen.u)
        focal = torch.arange(views) * _PARAMETERS + _FOCAL
        matrix, _ = system.reduce(torch.ones_like(seen.frame, dtype=torch.bool))
        inverse = chosen @ _inverse_of_scaled(chosen.mT @ (matrix + prior) @ chosen) @ chosen.mT
        cross = torch.einsum("vnri,vnrj->nvij", system.by_view, system.by_point).flatten(1, 2)
        length = system.residual.norm(dim=-1) / system.root.clamp(min=_LEAST)
        propagation = Propagation(
            slopes=Derivatives(system.root, system.by_view, system.by_point),
            inverse=inverse,
            cross=cross,
            eliminated=cross @ system.inverse,
            points=system.inverse,
            residual=system.residual,
            curvature=curvature(length, system.root.square(), self.loss_scale),
        )
        steps, _ = error_steps(_error_model(seen, state, noise), propagation, self.draws)
        at_centre = torch.arange(views)[:, None] * _PARAMETERS + _CENTRE + torch.arange(2)
        by_centre = (inverse @ prior[:, at_centre.flatten()])[focal]
        by_centre = by_centre * centre_std.repeat_interleave(2)
        common = by_centre.unflatten(1, (-1, 2)).sum(1)
        parts = (steps[focal], common, _OWN * by_centre)
        return torch.cat(parts, dim=-1).norm(dim=-1)


def _error_model(seen: View3D, state: Lenses, noise: Float[Tensor, " V"]) -> ErrorModel:
    frames = int(seen.frame.max()) + 1
    observed = Correspondences(
        xy=seen.u,
        noise=noise[:, None].expand_as(seen.valid),
        valid=seen.valid,
        frame=seen.frame,
        joint=seen.joint,
        row=seen.frame,
    )
    t = -(state.R @ state.centre[..., None])[..., 0]
    rig = PlacedRig(state.R, t, seen.valid.any(-1), state.points, seen.valid)
    points = state.points.unflatten(0, (frames, -1))
    known = seen.valid.any(0).unflatten(0, (frames, -1))
    height = float(stature(points, known)) or 1.0
    axes = turning(points, known).axes
    return ErrorModel.of(observed, rig, torch.arange(frames), axes, height)


def lens_errors(
    focal: FocalLengths, std: Float[Tensor, " V"], centre_std: Float[Tensor, " V"]
) -> LensErrors:
    """Return what is not known of estimated intrinsics; ``std``: of the focal lengths, relative;
    ``centre_std``: of the principal points all alike, in focal lengths.
    """
    views = len(std)
    of_focal = torch.diag(std) if focal is FocalLengths.EACH else std[:, None]
    common = centre_std[:, None, None] * torch.eye(2, dtype=std.dtype)
    own = _OWN * torch.diag(centre_std)[:, None, :, None] * torch.eye(2, dtype=std.dtype)[:, None]
    of_centre = torch.cat((common, own.flatten(2)), dim=-1)
    nothing = torch.zeros(views, of_centre.shape[-1], dtype=std.dtype)
    no_shift = torch.zeros(views, 2, of_focal.shape[-1], dtype=std.dtype)
    return LensErrors(
        focal=torch.cat((of_focal, nothing), dim=-1),
        centre=torch.cat((no_shift, of_centre), dim=-1),
    )


def _selection(views: int, focal: FocalLengths, with_k1: bool) -> Float[Tensor, "P Q"]:
    """Return the matrix from what is estimated to the parameters of all views."""
    columns = []
    eye = torch.eye(views * _PARAMETERS, dtype=torch.float64)
    first = torch.arange(views) * _PARAMETERS
    for view in range(views):
        columns.append(eye[:, view * _PARAMETERS : view * _PARAMETERS + _EXTRINSICS])
    for place, is_estimated in ((_FOCAL, True), (_K1, with_k1)):
        own = eye[:, first + place]
        if is_estimated:
            columns.append(own if focal is FocalLengths.EACH else own.sum(-1, keepdim=True))
    columns += [eye[:, first + _CENTRE], eye[:, first + _CENTRE + 1]]
    return torch.cat(columns, dim=-1)


def _prior(centre_std: Float[Tensor, " V"], weight: float) -> Float[Tensor, "P P"]:
    """Return the precision of what is known of the principal points beforehand, times a weight."""
    views = len(centre_std)
    alike = torch.ones(views, views, dtype=centre_std.dtype)
    own = _OWN**2 * torch.eye(views, dtype=centre_std.dtype)
    covariance = centre_std[:, None] * (alike + own) * centre_std
    precision = weight * torch.linalg.inv(covariance)
    prior = torch.zeros(views * _PARAMETERS, views * _PARAMETERS, dtype=centre_std.dtype)
    for axis in (0, 1):
        at = torch.arange(views) * _PARAMETERS + _CENTRE + axis
        prior[at[:, None], at] = precision
    return prior


def _prior_residual(state: Lenses) -> Float[Tensor, " P"]:
    """Return the parameters of all views that something is known of beforehand; 0 elsewhere."""
    x = torch.zeros(len(state.c), _PARAMETERS, dtype=state.c.dtype)
    x[:, _CENTRE:] = state.c
    return x.flatten()


def _project(
    seen: View3D, state: Lenses
) -> tuple[Float[Tensor, "V N 3"], Float[Tensor, "V N 2"], Bool[Tensor, "V N"]]:
    """Return the points from the cameras' centres and in normalised coordinates, and which of the
    used ones are in front.
    """
    arm = state.points - state.centre[:, None]
    in_camera = arm @ state.R.mT
    depth = in_camera[..., 2]
    front = seen.valid & (depth > 0)
    p = in_camera[..., :2] / torch.where(front, depth, 1.0)[..., None]
    return arm, p, front


def _residual(seen: View3D, state: Lenses) -> tuple[Float[Tensor, "V N 2"], Bool[Tensor, "V N"]]:
    _, p, front = _project(seen, state)
    s = p.square().sum(-1, keepdim=True)
    radial = 1 + state.k1[:, None, None] * s
    predicted = state.log_ratio.exp()[:, None, None] * radial * p + state.c[:, None]
    return torch.where(front[..., None], predicted - seen.u, 0.0), front


@dataclass(frozen=True)
class _System:
    """The normal equations, with the points not yet eliminated."""

    root: Float[Tensor, "V N"]
    """Square root of the weights."""
    by_view: Float[Tensor, "V N 2 P"]
    by_point: Float[Tensor, "V N 2 3"]
    residual: Float[Tensor, "V N 2"]
    """All three with these roots."""
    inverse: Float[Tensor, "N 3 3"]
    """Of the points' own matrices; 0 where a point is not fixed."""
    point_gradient: Float[Tensor, "N 3"]

    def reduce(
        self, points: Bool[Tensor, " N"]
    ) -> tuple[Float[Tensor, "P P"], Float[Tensor, " P"]]:
        """Return the matrix and the gradient of some points, which are eliminated."""
        by_view = self.by_view[:, points]
        by_point = self.by_point[:, points]
        own = torch.einsum("vnri,vnrj->vij", by_view, by_view)
        gradient = torch.einsum("vnri,vnr->vi", by_view, self.residual[:, points]).flatten()
        mixed = torch.einsum("vnri,vnrj->nvij", by_view, by_point).flatten(1, 2)
        solved = mixed @ self.inverse[points]
        solved_rows = solved.transpose(0, 1).flatten(1)
        matrix = torch.block_diag(*own) - solved_rows @ mixed.transpose(0, 1).flatten(1).mT
        eliminated = torch.einsum("npk,nk->p", solved, self.point_gradient[points])
        return (matrix + matrix.mT) / 2, gradient - eliminated

    def step(self, state: Lenses, change: Float[Tensor, " P"]) -> Lenses:
        """Return the state after a step of the views' parameters, with the points that go with
        it.
        """
        by_view = change.unflatten(0, (-1, _PARAMETERS))
        along = torch.einsum("vnri,vi->vnr", self.by_view, by_view)
        right = self.point_gradient + torch.einsum("vnrk,vnr->nk", self.by_point, along)
        moved = -(self.inverse @ right[..., None])[..., 0]
        turn = vector_to_matrix(by_view[:, :3])
        return Lenses(
            R=state.R @ turn.mT,
            centre=state.centre + by_view[:, 3:6],
            points=state.points + moved,
            log_ratio=state.log_ratio + by_view[:, _FOCAL],
            k1=state.k1 + by_view[:, _K1],
            c=state.c + by_view[:, _CENTRE:],
        )


def _linearise(
    seen: View3D, state: Lenses, noise: Float[Tensor, " V"], loss_scale: float
) -> _System:
    arm, p, front = _project(seen, state)
    residual, _ = _residual(seen, state)
    residual = residual / noise[:, None, None]
    weight = 1 / (1 + residual.square().sum(-1) / loss_scale**2)
    root = torch.where(front, weight, 0.0).sqrt()[..., None]
    scale = (state.log_ratio.exp() / noise)[:, None, None]
    k1 = state.k1[:, None, None]
    s = p.square().sum(-1, keepdim=True)
    depth = torch.where(front, (arm @ state.R.mT)[..., 2], 1.0)[..., None, None]
    one = torch.eye(2, dtype=p.dtype)
    by_p = scale[..., None] * ((1 + k1 * s)[..., None] * one + 2 * k1[..., None] * _outer(p))
    to_p = torch.cat((one.expand(*p.shape, 2), -p[..., None]), dim=-1) / depth
    by_point = by_p @ to_p @ state.R[:, None]
    predicted = scale * (1 + k1 * s) * p
    by_k1 = scale * s * p
    by_centre = (one / noise[:, None, None])[:, None].expand(*p.shape, 2)
    by_view = torch.cat(
        (
            by_point @ cross_matrix(arm),
            -by_point,
            predicted[..., None],
            by_k1[..., None],
            by_centre,
        ),
        dim=-1,
    )
    by_point = by_point * root[..., None]
    by_view = by_view * root[..., None]
    residual = residual * root
    matrix = torch.einsum("vnri,vnrj->nij", by_point, by_point)
    gradient = torch.einsum("vnri,vnr->ni", by_point, residual)
    return _System(root[..., 0], by_view, by_point, residual, _inverse(matrix), gradient)


def _outer(p: Float[Tensor, "*B 2"]) -> Float[Tensor, "*B 2 2"]:
    return p[..., :, None] * p[..., None, :]


def _inverse(matrix: Float[Tensor, "N 3 3"]) -> Float[Tensor, "N 3 3"]:
    trace = matrix.diagonal(dim1=-2, dim2=-1).sum(-1)
    safe = torch.where(trace > 0, trace, 1.0)[:, None, None]
    scaled = matrix / safe
    solvable = (trace > 0) & (torch.linalg.det(scaled) > 1e-18)
    eye = torch.eye(3, dtype=matrix.dtype)
    inverse = torch.linalg.inv(torch.where(solvable[:, None, None], scaled, eye))
    return torch.where(solvable[:, None, None], inverse / safe, 0.0)


def _inverse_of_scaled(matrix: Float[Tensor, "Q Q"]) -> Float[Tensor, "Q Q"]:
    """Return the inverse of a matrix that is singular along the gauge, with that left out."""
    scale, values, vectors = precondition(matrix)
    known = values > 1e-10 * values[-1].clamp_min(1e-300)
    basis = scale[:, None] * vectors[:, known]
    return basis / values[known] @ basis.mT


def seen_by(
    K: Float[Tensor, "V 3 3"], key_points: Float[Tensor, "T V J 2"], valid: Bool[Tensor, "T V J"]
) -> View3D:
    """Return the key points of cameras whose K is a first guess."""
    frames, _, joints = valid.shape
    flat = valid.transpose(0, 1).flatten(1)
    pixels = torch.where(valid[..., None], key_points, 0.0).transpose(0, 1).flatten(1, 2)
    u = torch.where(flat[..., None], normalise(K, pixels), 0.0)
    frame = torch.arange(frames).repeat_interleave(joints)
    return View3D(u, flat, frame, torch.arange(joints).repeat(frames))


def state_of(
    R: Float[Tensor, "V 3 3"], t: Float[Tensor, "V 3"], points: Float[Tensor, "N 3"]
) -> Lenses:
    """Return the state of a rig that was calibrated with the first guess."""
    nothing = torch.zeros(len(R), dtype=torch.float64)
    centre = torch.zeros(len(R), 2, dtype=torch.float64)
    return Lenses(R, camera_centre(R, t), points, nothing, nothing, centre)


def with_focal(K: Float[Tensor, "V 3 3"], ratio: Float[Tensor, " V"]) -> Float[Tensor, "V 3 3"]:
    """Return intrinsics with other focal lengths."""
    scaled = K.clone()
    scaled[:, :2, :2] = K[:, :2, :2] * ratio[:, None, None]
    return scaled


def without(seen: View3D, views: Bool[Tensor, " V"]) -> View3D:
    """Return the same without what some views see."""
    return replace(seen, valid=seen.valid & ~views[:, None])
