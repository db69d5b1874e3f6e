"""The key-point problem: a hypothesis is a key point, and its weight is what it is worth.

The estimate is one weighted triangulation of all joints, and learning goes end to end through it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.geometry.triangulation import Triangulation, triangulate
from ghpt.models.estimators.ransac import AdaptiveRansac
from ghpt.models.key_points.features import NAMES, featurize, measure
from ghpt.models.pose.problem import PoseProblem
from ghpt.models.pose.robust_error import robust_error
from ghpt.models.problem import Errors, Features, Hypotheses, Keys, Weights
from ghpt.observations import Observations, PoseEstimate, Truth

_FAR = 1e4
"""mm: no key point is farther from the truth than that."""


@dataclass(frozen=True)
class KeyPoints(Hypotheses):
    """H = V x J key points of each of B frames, and a first estimate made of them."""

    shared = ("observations", "start")

    observations: Observations
    start: PoseEstimate
    """World, mm, float64."""

    def usable(self) -> Bool[Tensor, "B V J"]:
        """Return which key points see a joint that has a first estimate."""
        return self.observations.valid & self.start.estimated[:, None]


class KeyPointWeights(PoseProblem):
    """3D poses from all key points, each weighted; compared by MPJPE.

    ``threshold``, ``pairs``, ``adapt``, ``quantile`` and ``rounds``: of the AdaptiveRansac of the
    first estimate, beside which a key point is judged.
    """

    aggregations = ("weight", "average")

    def __init__(
        self, threshold: float, pairs: int, adapt: float, quantile: float, rounds: int
    ) -> None:
        self.start = AdaptiveRansac(threshold, pairs, 0, adapt, quantile, rounds)
        self.feature_size = len(NAMES)

    @torch.no_grad()
    def generate(self, observations: Observations, count: int, keys: Keys) -> KeyPoints:
        """Return the key points of each frame, whatever ``count`` is: they are what there is."""
        result = self.start.triangulate(observations)
        return KeyPoints(observations, PoseEstimate(result.points, result.has_position))

    @torch.no_grad()
    def featurize(self, hypotheses: KeyPoints) -> Features:
        """Return ``ghpt.models.key_points.features.NAMES`` of each key point."""
        return featurize(hypotheses.observations, hypotheses.start).flatten(1, 2)

    def aggregate(self, hypotheses: KeyPoints, weights: Weights) -> PoseEstimate:
        """Return the weighted triangulation; the first estimate where that has no point."""
        result = self.triangulate(hypotheses, weights)
        start = hypotheses.start
        points = torch.where(result.ok[..., None], result.points, start.points)
        return PoseEstimate(points, start.estimated)

    def triangulate(self, hypotheses: KeyPoints, weights: Weights) -> Triangulation:
        """Return the weighted triangulation.

        A weight is of the squared distance at the depth of the body, not in pixels.
        """
        observations = hypotheses.observations
        usable = hypotheses.usable()
        K = observations.cameras.K
        focal = (K[..., 0, 0] * K[..., 1, 1]).sqrt()
        weight = weights.double().unflatten(1, usable.shape[1:]) / focal[..., None] ** 2
        weight = torch.where(usable, weight, 0.0)
        return triangulate(observations.cameras, observations.key_points, weight)

    def as_estimates(self, hypotheses: KeyPoints) -> KeyPoints:
        """Return the key points: no pose can be made of one."""
        return hypotheses

    def error(self, estimate: PoseEstimate | KeyPoints, truth: Truth) -> Errors:
        """Return the pelvis-relative MPJPE of an estimate, mm.

        The error of a key point is how far it is from the joint at the joint's depth; 0 for one
        that is not usable.
        """
        if isinstance(estimate, PoseEstimate):
            return super().error(estimate, truth)
        true_pose = PoseEstimate(truth.points.double(), truth.valid)
        geometry = measure(estimate.observations, true_pose)
        distance = geometry.residual.norm(dim=-1) * geometry.unit[:, None, None]
        usable = estimate.usable() & truth.valid[:, None]
        distance = torch.where(usable, distance.clamp(max=_FAR), 0.0)
        return distance.flatten(1), usable.flatten(1).any(-1)

    def training_error(self, estimate: PoseEstimate, truth: Truth) -> Float[Tensor, " B"]:
        """Return `robust_error`."""
        return robust_error(estimate, truth)
