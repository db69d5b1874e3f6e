"""Classical estimators on the same key points as the learned one, and with the same output type.

Thresholds and scales are fractions of the person's size in each view's image (the diagonal of the
box of the seen key points), so that they mean the same at any resolution and distance. A robust
estimator that finds nothing better falls back to the all-view linear one: it never gains by leaving
hard joints out.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.errors import check, check_positive
from ghpt.geometry.cameras import reprojection_error
from ghpt.geometry.reweighting import WEIGHTS, triangulate_robustly
from ghpt.geometry.triangulation import Triangulation, triangulate
from ghpt.observations import Observations, PoseEstimate


def person_scale(
    key_points: Float[Tensor, "*B V J 2"], valid: Bool[Tensor, "*B V J"]
) -> Float[Tensor, "*B V"]:
    """Diagonal (pixels) of the box around the seen key points of each view; 0 where fewer than two
    are seen.
    """
    valid = (valid & torch.isfinite(key_points).all(-1))[..., None]
    largest = torch.where(valid, key_points, -torch.inf).amax(-2)
    smallest = torch.where(valid, key_points, torch.inf).amin(-2)
    return torch.where(valid.any(-2), largest - smallest, 0.0).norm(dim=-1)


def otherwise(first: Triangulation, second: Triangulation) -> Triangulation:
    """``first`` where it is ok, ``second`` elsewhere."""
    chosen = {}
    for field in fields(Triangulation):
        a = getattr(first, field.name)
        b = getattr(second, field.name)
        chosen[field.name] = torch.where(
            first.ok[..., None] if a.ndim > first.ok.ndim else first.ok, a, b
        )
    return Triangulation(**chosen)


def poses_of(result: Triangulation, batch: Observations) -> PoseEstimate:
    return PoseEstimate(result.points.to(batch.key_points.dtype), result.has_position)


def everywhere(value: float, batch: Observations) -> Float[Tensor, " B"]:
    return torch.full(batch.index.shape, value, dtype=torch.float64, device=batch.index.device)


class Estimator(ABC):
    """A classical estimator: ``baseline(batch)`` gives a PoseEstimate in the dtype of the key
    points.
    """

    @abstractmethod
    def triangulate(self, batch: Observations) -> Triangulation:
        """The batch's joints with their status."""

    def inlier_threshold(
        self, batch: Observations, points: Float[Tensor, "B J 3"]
    ) -> Float[Tensor, " B"] | None:
        """Largest residual of a view that counts as one that made the joint, as a fraction of the
        person's size, for the ``points`` that this found; None where all views do.
        """
        return None

    def inlier_views(
        self, batch: Observations, points: Float[Tensor, "B J 3"], placed: Bool[Tensor, "B J"]
    ) -> tuple[Bool[Tensor, "B V J"], Bool[Tensor, "B J"]]:
        """The views that made each of the ``points`` that are ``placed``, and whether two of them
        agree; all that see the joint where fewer than two are within reach.
        """
        given = batch.valid & placed[:, None]
        inlier_threshold = self.inlier_threshold(batch, points)
        if inlier_threshold is None:
            return given, placed
        limit = inlier_threshold[:, None] * person_scale(batch.key_points, batch.valid)
        near = given & (
            reprojection_error(batch.cameras, batch.key_points, points) <= limit[..., None]
        )
        agreed = near.sum(1) >= 2
        return torch.where(agreed[:, None], near, given), agreed

    @torch.no_grad()
    def __call__(self, batch: Observations) -> PoseEstimate:
        return poses_of(self.triangulate(batch), batch)


class Linear(Estimator):
    """All seen views with equal weights."""

    def triangulate(self, batch: Observations) -> Triangulation:
        return triangulate(batch.cameras, batch.key_points, batch.valid.to(batch.key_points.dtype))


@dataclass(frozen=True)
class WeightedLinear(Estimator):
    """All seen views; the detector's confidence to the power ``power`` weights the squared
    residuals.
    """

    power: float

    def __post_init__(self) -> None:
        check_positive(power=self.power)

    def triangulate(self, batch: Observations) -> Triangulation:
        weights = torch.where(batch.valid, batch.confidence.clamp(min=0) ** self.power, 0.0)
        return otherwise(
            triangulate(batch.cameras, batch.key_points, weights), Linear().triangulate(batch)
        )


@dataclass(frozen=True)
class MEstimator(Estimator):
    """Iteratively reweighted least squares on the reprojection error, from the linear estimate.

    ``scale``: where the loss turns robust, as a fraction of the person's size in each view. Each
    view's weight is that of its residual under ``loss`` over its squared depth, which turns the
    rows' residuals into pixels. A joint whose last step is longer than ``tolerance`` (mm) has the
    status NOT_CONVERGED and its last point.
    """

    loss: Literal["huber", "cauchy", "geman_mcclure"]
    scale: float
    iterations: int
    tolerance: float

    def __post_init__(self) -> None:
        check(
            self.loss in WEIGHTS, "loss", f"is {self.loss!r}", f"Choose from {', '.join(WEIGHTS)}."
        )
        check_positive(scale=self.scale, iterations=self.iterations, tolerance=self.tolerance)

    def inlier_threshold(
        self, batch: Observations, points: Float[Tensor, "B J 3"]
    ) -> Float[Tensor, " B"]:
        """The scale: a residual of that size has a quarter (Geman-McClure), half (Cauchy) or all
        (Huber) of the weight.
        """
        return everywhere(self.scale, batch)

    def triangulate(self, batch: Observations) -> Triangulation:
        scale = (self.scale * person_scale(batch.key_points, batch.valid)).clamp(min=1e-12)
        return triangulate_robustly(
            batch.cameras,
            batch.key_points,
            batch.valid,
            scale,
            WEIGHTS[self.loss],
            self.iterations,
            self.tolerance,
        )
