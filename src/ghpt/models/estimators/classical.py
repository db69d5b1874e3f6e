"""Classical estimators on the same key points as the learned one, and with the same output type.

Thresholds and scales are fractions of the person's scale in each view's image (the diagonal of the
box of the valid key points), so that they mean the same at any resolution and distance. A robust
estimator that finds nothing better falls back to the all-view linear one: it never gains by leaving
hard joints out.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal, Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.errors import check, check_positive
from ghpt.geometry.cameras import reprojection_error
from ghpt.geometry.reweighting import WEIGHTS, triangulate_robustly
from ghpt.geometry.triangulation import Triangulation, triangulate
from ghpt.models.estimators.confidence import confidence_exponent, confidence_weights
from ghpt.observations import Observations, PoseEstimate
from ghpt.skeleton import Skeleton


def person_scale(
    key_points: Float[Tensor, "*B V J 2"], valid: Bool[Tensor, "*B V J"]
) -> Float[Tensor, "*B V"]:
    """Return the diagonal (pixels) of the box around the valid key points of each view.

    It is 0 where fewer than two are valid.
    """
    finite = torch.isfinite(key_points).all(-1)
    valid = (valid & finite)[..., None]
    largest = torch.where(valid, key_points, -torch.inf).amax(-2)
    smallest = torch.where(valid, key_points, torch.inf).amin(-2)
    extent = torch.where(valid.any(-2), largest - smallest, 0.0)
    return extent.norm(dim=-1)


def fall_back(robust: Triangulation, full: Triangulation) -> Triangulation:
    """Return ``robust`` where it is ok, and ``full``, of all views, elsewhere."""
    return robust.with_fallback(robust.ok, full)


def as_poses(result: Triangulation, batch: Observations) -> PoseEstimate:
    """Return the joints in the dtype of the batch's key points."""
    points = result.points.to(batch.key_points.dtype)
    return PoseEstimate(points, result.has_position)


def fill_frames(value: float, batch: Observations) -> Float[Tensor, " B"]:
    """Return the value for each frame of the batch, float64."""
    index = batch.index
    return torch.full(index.shape, value, dtype=torch.float64, device=index.device)


class Estimator(ABC):
    """A classical estimator: ``estimator(batch)`` gives a PoseEstimate.

    Its points have the dtype of the key points.
    """

    sort: ClassVar[str] = "a classical estimator"
    """What it is, in a sentence."""

    @abstractmethod
    def triangulate(self, batch: Observations) -> Triangulation:
        """Return the batch's joints with their states."""

    def fit_to(self, batch: Observations) -> Self:
        """Return the same estimator with what it takes from these frames of a recording."""
        return self

    def for_skeleton(self, skeleton: Skeleton) -> Self:
        """Return the same estimator for batches of another skeleton than the 17 joints'."""
        return self

    def inlier_threshold(
        self, batch: Observations, points: Float[Tensor, "B J 3"]
    ) -> Float[Tensor, " B"] | None:
        """Return the largest residual of a view that counts as one that made the joint.

        It is a fraction of the person's scale, for the ``points`` that this estimator found; None
        where all views count.
        """
        return None

    def inlier_views(
        self,
        batch: Observations,
        points: Float[Tensor, "B J 3"],
        has_position: Bool[Tensor, "B J"],
    ) -> tuple[Bool[Tensor, "B V J"], Bool[Tensor, "B J"]]:
        """Return the views that made each joint, and whether two of them agree on it.

        Where fewer than two are within the threshold, these are all views that see the joint.
        """
        full = batch.valid & has_position[:, None]
        threshold = self.inlier_threshold(batch, points)
        if threshold is None:
            return full, has_position
        limit = threshold[:, None] * person_scale(batch.key_points, batch.valid)
        error = reprojection_error(batch.cameras, batch.key_points, points)
        inlier = full & (error <= limit[..., None])
        agreed = inlier.sum(1) >= 2
        return torch.where(agreed[:, None], inlier, full), agreed

    @torch.no_grad()
    def __call__(self, batch: Observations) -> PoseEstimate:
        return as_poses(self.triangulate(batch), batch)


@dataclass(frozen=True)
class ConfidenceWeighted(Estimator):
    """An estimator that weights the views that it takes by their confidence to a power.

    ``confidence_exponent``: the power; 0 counts them alike. ``fit_to`` measures it on a recording.
    """

    confidence_exponent: float = field(default=0.0, kw_only=True)

    def fit_to(self, batch: Observations) -> Self:
        result = self.triangulate(batch)
        scale = person_scale(batch.key_points, batch.valid).clamp(min=1e-12)
        error = reprojection_error(batch.cameras, batch.key_points, result.points)
        measured = batch.valid & result.has_position[:, None]
        exponent = confidence_exponent(error / scale[..., None], batch.confidence, measured)
        return replace(self, confidence_exponent=exponent)

    def confidence_weights(self, batch: Observations) -> Float[Tensor, "B V J"]:
        """Return the weights of the squared residuals."""
        return confidence_weights(batch.confidence, self.confidence_exponent)


class Linear(Estimator):
    """All valid views with equal weights."""

    def triangulate(self, batch: Observations) -> Triangulation:
        weights = batch.valid.to(batch.key_points.dtype)
        return triangulate(batch.cameras, batch.key_points, weights)


@dataclass(frozen=True)
class WeightedLinear(Estimator):
    """All valid views, weighted by confidence.

    The detector's confidence to the power ``power`` weights the squared residuals.
    """

    power: float

    def __post_init__(self) -> None:
        check_positive(power=self.power)

    def triangulate(self, batch: Observations) -> Triangulation:
        power = batch.confidence.clamp(min=0) ** self.power
        weights = torch.where(batch.valid, power, 0.0)
        weighted = triangulate(batch.cameras, batch.key_points, weights)
        return fall_back(weighted, Linear().triangulate(batch))


@dataclass(frozen=True)
class MEstimator(ConfidenceWeighted):
    """Iteratively reweighted least squares on the reprojection error, from the linear estimate.

    ``scale``: where the loss turns robust, as a fraction of the person's size in each view. Each
    view's weight is that of its residual under ``loss`` over its squared depth, which turns the
    rows' residuals into pixels. A joint whose last step is longer than ``tolerance`` (mm) has the
    state NOT_CONVERGED and its last point.
    """

    loss: Literal["huber", "cauchy", "geman_mcclure"]
    scale: float
    iterations: int
    tolerance: float

    def __post_init__(self) -> None:
        hint = f"Choose from {', '.join(WEIGHTS)}."
        check(self.loss in WEIGHTS, "loss", f"is {self.loss!r}", hint)
        check_positive(scale=self.scale, iterations=self.iterations, tolerance=self.tolerance)

    def inlier_threshold(
        self, batch: Observations, points: Float[Tensor, "B J 3"]
    ) -> Float[Tensor, " B"]:
        """Return the scale of the loss.

        A residual of that size has a quarter (Geman-McClure), half (Cauchy) or all (Huber) of the
        weight.
        """
        return fill_frames(self.scale, batch)

    def triangulate(self, batch: Observations) -> Triangulation:
        scale = self.scale * person_scale(batch.key_points, batch.valid)
        return triangulate_robustly(
            batch.cameras,
            batch.key_points,
            batch.valid,
            scale.clamp(min=1e-12),
            self.confidence_weights(batch),
            WEIGHTS[self.loss],
            self.iterations,
            self.tolerance,
        )
