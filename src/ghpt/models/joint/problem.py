"""The joint problem: a hypothesis is one joint, triangulated from a random subset of the views.

The paper's idea for each joint by itself: the scorer sees hypotheses in 3D, in the pose around
them, and never cameras. A joint is the weighted average of its hypotheses.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ghpt.geometry.subsets import random_subsets
from ghpt.geometry.triangulation import triangulate_subsets
from ghpt.models.joint.features import SIZE, featurize
from ghpt.models.pose.problem import PoseProblem
from ghpt.models.pose.robust_error import robust_error
from ghpt.models.problem import Errors, Features, Hypotheses, Keys, Weights
from ghpt.observations import Observations, PoseEstimate, Truth


@dataclass(frozen=True)
class JointHypotheses(Hypotheses):
    """H = S x J joints of each of B frames: S of each joint, the first of which is the context."""

    shared = ("points", "context")

    points: Float[Tensor, "B S J 3"]
    """World, mm, float64."""
    context: PoseEstimate
    """A first estimate of the pose: world, mm, float64."""


class JointSubsets(PoseProblem):
    """3D poses whose joints are averages of triangulations from random views; compared by MPJPE.

    ``context``: name of the weights of key points (``ghpt/weights``) that give the first estimate.
    A subset is of the views of the frame, so that all joints have the same ones, each without those
    that miss it.
    """

    aggregations = ("weight", "average")

    def __init__(self, context: str) -> None:
        self.context = context
        self.feature_size = SIZE

    @torch.no_grad()
    def generate(self, observations: Observations, count: int, keys: Keys) -> JointHypotheses:
        """Return ``count`` hypotheses of each joint beside the first estimate."""
        from ghpt.models.weights import load_shipped  # which builds problems, this one too

        model = load_shipped(self.context)
        pool = model.sample(observations, "context")
        return self.generate_around(observations, pool.estimate(), count, keys)

    @torch.no_grad()
    def generate_around(
        self, observations: Observations, context: PoseEstimate, count: int, keys: Keys
    ) -> JointHypotheses:
        """Return the same beside a given first estimate.

        Where a subset leaves a joint fewer than two views, or a degenerate pair, the hypothesis is
        the first estimate.
        """
        valid = observations.valid
        subsets = random_subsets(valid.any(2, keepdim=True), count, keys)
        views = subsets & valid.mT[:, None]
        points, ok = triangulate_subsets(
            observations.cameras, observations.key_points, valid, views
        )
        first = context.points.double()[:, None]
        ok = ok & (views.sum(-1) >= 2)
        points = torch.where(ok[..., None], points, first)
        return JointHypotheses(torch.cat((first, points), dim=1), context)

    @torch.no_grad()
    def featurize(self, hypotheses: JointHypotheses) -> Features:
        """Return ``ghpt.models.joint.features`` of each hypothesis."""
        return featurize(hypotheses.points, hypotheses.context).flatten(1, 2)

    def aggregate(self, hypotheses: JointHypotheses, weights: Weights) -> PoseEstimate:
        """Return the average of each joint's hypotheses under their share of the weights."""
        points = hypotheses.points
        context = hypotheses.context
        weight = weights.double().unflatten(1, points.shape[1:3])
        total = weight.sum(1, keepdim=True)
        share = weight / total.clamp_min(torch.finfo(total.dtype).tiny)
        first = context.points.double()
        offset = torch.einsum("bsj,bsjc->bjc", share, points - first[:, None])
        return PoseEstimate(first + offset, context.estimated)

    def as_estimates(self, hypotheses: JointHypotheses) -> JointHypotheses:
        """Return the hypotheses: no pose can be made of one."""
        return hypotheses

    def error(self, estimate: PoseEstimate | JointHypotheses, truth: Truth) -> Errors:
        """Return the pelvis-relative MPJPE of an estimate, mm.

        The error of a hypothesis is its distance from the joint; 0 where that is not estimated.
        """
        if isinstance(estimate, PoseEstimate):
            return super().error(estimate, truth)
        counted = estimate.context.estimated & truth.valid
        distance = (estimate.points - truth.points.double()[:, None]).norm(dim=-1)
        distance = torch.where(counted[:, None], distance, 0.0)
        return distance.flatten(1), counted.any(-1)

    def training_error(self, estimate: PoseEstimate, truth: Truth) -> Float[Tensor, " B"]:
        """Return `robust_error`."""
        return robust_error(estimate, truth)
