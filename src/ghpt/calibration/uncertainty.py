"""Covariance of a rig's extrinsics: what the errors that its residuals show do to it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.calibration.error_model import ErrorModel, variances
from ghpt.calibration.normal_matrix import BEHIND, Derivatives, NormalEquations, residuals
from ghpt.calibration.observations import Correspondences
from ghpt.calibration.resection import PlacedRig
from ghpt.geometry.epipolar import cross_matrix

_SEED = 0


@dataclass(frozen=True)
class Uncertainty:
    """In the gauge of the rig as a whole (free network): the similarity that the data cannot know
    (rotation, place and scale of all cameras together) is that which brings the cameras nearest to
    the true ones, radians and centres in units of the rig's size counting alike.
    """

    covariance: Float[Tensor, "P P"]
    """Of all views together: for each the rotation vector about the world's axes (radians), then
    the centre (world); 0 for a view that is not placed.
    """
    lasting: float
    """The share of the rotations' variance that more of the same recording would leave: errors that
    last as long as people show a view the same side.
    """


def gauge(R: Float[Tensor, "V 3 3"], centre: Float[Tensor, "V 3"]) -> Float[Tensor, "P 7"]:
    """The changes of the views' parameters that change no image: common rotation, translation,
    scale.
    """
    eye = torch.eye(3, dtype=centre.dtype).expand(len(centre), 3, 3)
    rotation = torch.cat((eye, -cross_matrix(centre)), dim=1)
    translation = torch.cat((torch.zeros_like(eye), eye), dim=1)
    scale = torch.cat((torch.zeros_like(centre), centre), dim=1)[..., None]
    return torch.cat((rotation, translation, scale), dim=-1).flatten(0, 1)


def uncertainty(
    model: ErrorModel,
    rig: PlacedRig,
    scale: float,
    draws: int,
    lenses: LensErrors | None = None,
) -> Uncertainty:
    """Return the covariance of a rig, whose size (root mean square distance of the centres from
    their mean) is 1; ``scale``: of its Cauchy loss, units of noise; ``lenses``: what is not known
    of the intrinsics.
    """
    parameters = 6 * len(rig.R)
    views = torch.nonzero(rig.placed)[:, 0]
    if len(views) < 2 or not rig.inlier.any():
        return Uncertainty(torch.zeros(parameters, parameters, dtype=torch.float64), 0.0)
    propagation = Propagation.of(model.observed, rig, scale)
    steps, lasts = error_steps(model, propagation, draws)
    if lenses is not None:
        of_lenses = propagation(lenses.shifts(model.observed))[0]
        steps = torch.cat((steps, of_lenses), dim=-1)
        lasts = torch.cat((lasts, torch.ones(of_lenses.shape[-1], dtype=torch.bool)))
    rotation = steps.unflatten(0, (-1, 6))[:, :3].square().sum((0, 1))
    lasting = float(rotation[lasts].sum() / rotation.sum().clamp(min=1e-300))
    return Uncertainty(steps @ steps.mT, lasting)


def blocks_of(covariance: Float[Tensor, "P P"]) -> Float[Tensor, "V 6 6"]:
    """Return each view's own part of a covariance of all views together."""
    parts = covariance.unflatten(0, (-1, 6)).unflatten(2, (-1, 6))
    return parts.diagonal(dim1=0, dim2=2).permute(2, 0, 1)


def rotation_std_deg(covariance: Float[Tensor, "V 6 6"]) -> Float[Tensor, " V"]:
    """Return the standard deviation of each camera's rotation: of the angle about whatever axis."""
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    return torch.rad2deg(variance[:, :3].sum(-1).sqrt())


def centre_std(covariance: Float[Tensor, "V 6 6"]) -> Float[Tensor, " V"]:
    """Return the standard deviation of each camera's centre: of its distance from the true one."""
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    return variance[:, 3:].sum(-1).sqrt()


@dataclass(frozen=True)
class LensErrors:
    """S independent errors of the intrinsics of V views, each of one standard deviation."""

    focal: Float[Tensor, "V S"]
    """Relative, of the focal lengths."""
    centre: Float[Tensor, "V 2 S"]
    """Of the principal points, in focal lengths."""

    def shifts(self, observed: Correspondences) -> Float[Tensor, "V N 2 S"]:
        """Return what they change in the key points, in units of noise."""
        shift = observed.xy[..., None] * self.focal[:, None, None] + self.centre[:, None]
        return shift / observed.noise[..., None, None]


def error_steps(
    model: ErrorModel, propagation: Propagation, draws: int
) -> tuple[Float[Tensor, "P M"], Bool[Tensor, " M"]]:
    """Return M steps of the views' parameters whose squares sum to their covariance, and which of
    them belong to errors that last.

    1. ``draws`` errors of each kind of the model, or more, are propagated to the parameters, and to
       the residuals that remain.
    2. The variances of the kinds are those whose residuals have the moments of the true residuals,
       as far as these tell them (``variances``).
    3. Along an error the loss bends less than its weight says, which enlarges the steps.
    """
    steps = []
    moments = []
    lasts = []
    lasting = []
    for kind in model.kinds(draws, _SEED):
        step, residual = propagation(kind.draws)
        moments.append(model.moments(residual[..., :draws], propagation.used).mean(-1))
        steps.append(step / step.shape[-1] ** 0.5)
        lasts.append(torch.full(step.shape[-1:], kind.lasts))
        lasting.append(kind.lasts)
    seen = model.moments(propagation.residual[..., None], propagation.used)[:, 0]
    variance = variances(seen, torch.stack(moments, dim=-1), torch.tensor(lasting))
    sizes = variance.sqrt() / propagation.curvature
    scaled = [size * step for size, step in zip(sizes, steps, strict=True)]
    return torch.cat(scaled, dim=-1), torch.cat(lasts)


@dataclass(frozen=True)
class Propagation:
    """From errors of key points, in units of noise, to the P parameters of all views and the
    residuals that remain, in first order.
    """

    slopes: Derivatives
    inverse: Float[Tensor, "P P"]
    """Of the normal matrix, gauge left out."""
    cross: Float[Tensor, "N P 3"]
    eliminated: Float[Tensor, "N P 3"]
    points: Float[Tensor, "N 3 3"]
    """Inverse matrices of the points."""
    residual: Float[Tensor, "V N 2"]
    """The rig's own, weighted."""
    curvature: float
    """Of the loss, over its weight."""

    @classmethod
    def of(cls, observed: Correspondences, rig: PlacedRig, scale: float) -> Propagation:
        """Return the propagation through a rig's adjustment."""
        now = residuals(observed, rig, rig.inlier & rig.placed[:, None], scale)
        slopes = Derivatives.of(observed, rig, now)
        equations = NormalEquations.of(observed, rig, now)
        reduced = equations.reduce()
        views = torch.nonzero(rig.placed)[:, 0]
        own = (6 * views[:, None] + torch.arange(6)).flatten()
        basis = torch.linalg.svd(gauge(rig.R[views], rig.centre[views]))[0][:, 7:]
        matrix = basis.T @ reduced.matrix()[own][:, own] @ basis
        values, vectors = torch.linalg.eigh((matrix + matrix.T) / 2)
        values = values.clamp_min(1e-14 * values[-1].clamp_min(1e-300))
        inverse = torch.zeros(6 * len(rig.R), 6 * len(rig.R), dtype=torch.float64)
        inverse[own[:, None], own] = basis @ (vectors / values @ vectors.T) @ basis.T
        return cls(
            slopes=slopes,
            inverse=inverse,
            cross=equations.cross,
            eliminated=reduced.eliminated,
            points=reduced.inverse,
            residual=slopes.root[..., None] * now.error,
            curvature=curvature(now.error.norm(dim=-1), now.weight, scale),
        )

    @property
    def used(self) -> Bool[Tensor, "V N"]:
        """Which observations the rig rests on."""
        return self.slopes.root > 0

    def __call__(
        self, errors: Float[Tensor, "V N 2 D"]
    ) -> tuple[Float[Tensor, "P D"], Float[Tensor, "V N 2 D"]]:
        """Return the steps of the views, and the weighted residuals."""
        weighted = self.slopes.root[..., None, None] * errors
        by_view = self.slopes.by_view
        by_point = self.slopes.by_point
        of_views = by_view.flatten(1, 2).mT @ weighted.flatten(1, 2)
        # the sums over views and both rows are one product for each point
        rows = by_point.transpose(0, 1).flatten(1, 2)
        of_points = rows.mT @ weighted.transpose(0, 1).flatten(1, 2)
        reduced = torch.tensordot(self.eliminated, of_points, dims=([0, 2], [0, 1]))
        step = self.inverse @ (of_views.flatten(0, 1) - reduced)
        moved = self.points @ (of_points - self.cross.mT @ step)
        of_step = by_view.flatten(1, 2) @ step.unflatten(0, (len(by_view), -1))
        of_move = (rows @ moved).unflatten(1, (-1, 2)).transpose(0, 1)
        return step, of_step.view_as(weighted) + of_move - weighted


def curvature(error: Float[Tensor, "V N"], weight: Float[Tensor, "V N"], scale: float) -> float:
    """Return the mean curvature of the Cauchy loss over its weight."""
    used = weight > 0
    error = error[used].clamp(max=BEHIND)
    weight = weight[used]
    along = weight.square() * (1 - (error / scale) ** 2)
    return max(float(((weight + along) / 2).mean() / weight.mean()), 0.1)
