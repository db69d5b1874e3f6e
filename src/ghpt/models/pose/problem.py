"""The pose problem (paper, section 3.1): a hypothesis triangulates each joint from its own random
subset of views.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.errors import check
from ghpt.geometry.subsets import random_subsets
from ghpt.geometry.triangulation import triangulate, triangulate_subsets
from ghpt.metrics.pose_error import joint_errors
from ghpt.models.pose.features import body_part_lengths, normalised_coordinates
from ghpt.models.problem import Hypotheses
from ghpt.observations import Observations, PoseEstimate, Truth
from ghpt.skeleton import BONES, JOINTS


@dataclass(frozen=True)
class PoseHypotheses(Hypotheses):
    """H 3D poses for each of B frames."""

    shared = ("estimated",)

    points: Float[Tensor, "B H J 3"]
    """World frame, mm, float32."""
    views: Bool[Tensor, "B H J V"]
    """Which views made which joint."""
    estimated: Bool[Tensor, "B J"]
    """The joints that the frame's views determine; the others are in no hypothesis."""


class PoseTriangulation:
    """Generate, describe, combine and measure 3D poses."""

    measures = "MPJPE relative to the pelvis"

    def __init__(self, coordinates: bool, lengths: bool) -> None:
        check(
            coordinates or lengths,
            "model.problem",
            "neither coordinates nor lengths is on",
            "Switch on at least one kind of features.",
        )
        self.coordinates = coordinates
        self.lengths = lengths
        self.feature_size = len(JOINTS) * 3 * coordinates + len(BONES) * lengths

    @torch.no_grad()
    def generate(self, batch: Observations, count: int, keys: Int[Tensor, " B"]) -> PoseHypotheses:
        """Joint by joint a uniformly random subset of at least two seen views, triangulated.

        Where a subset is degenerate (parallel rays, a point behind a camera), all seen views stand
        in for it, so that every hypothesis has every joint that the frame determines.
        """
        whole = triangulate(batch.cameras, batch.key_points, batch.valid.double())
        views = random_subsets(batch.valid, count, keys)
        points, ok = triangulate_subsets(batch.cameras, batch.key_points, batch.valid, views)
        points = torch.where(ok[..., None], points, whole.points[:, None])
        views = torch.where(ok[..., None], views, batch.valid.mT[:, None])
        return PoseHypotheses(points.float(), views, whole.ok)

    @torch.no_grad()
    def featurize(self, hypotheses: PoseHypotheses) -> Float[Tensor, "B H D"]:
        """Normalised coordinates and body part lengths, mm."""
        estimated = hypotheses.estimated[:, None].expand(hypotheses.points.shape[:-1])
        kinds = [
            function(hypotheses.points, estimated)
            for function, wanted in (
                (normalised_coordinates, self.coordinates),
                (body_part_lengths, self.lengths),
            )
            if wanted
        ]
        return torch.cat(kinds, dim=-1)

    def aggregate(self, hypotheses: PoseHypotheses, weights: Float[Tensor, "B H"]) -> PoseEstimate:
        """The weighted average of the poses, taken about the pool's mean so that float32 keeps its
        digits.
        """
        centre = hypotheses.points.mean(dim=1, keepdim=True)
        offset = torch.einsum("bh,bhjc->bjc", weights.to(centre.dtype), hypotheses.points - centre)
        return PoseEstimate(centre[:, 0] + offset, hypotheses.estimated)

    def as_estimates(self, hypotheses: PoseHypotheses) -> PoseEstimate:
        estimated = hypotheses.estimated[:, None].expand(hypotheses.points.shape[:-1])
        return PoseEstimate(hypotheses.points, estimated)

    def error(
        self, estimate: PoseEstimate, truth: Truth
    ) -> tuple[Float[Tensor, " B *H"], Bool[Tensor, " B"]]:
        """Pelvis-relative MPJPE (eq:mpjpe) over the joints that are estimated and have a truth, mm."""
        extra = (None,) * (estimate.points.dim() - 3)
        points = truth.points[:, *extra].expand_as(estimate.points)
        valid = truth.valid[:, *extra].expand_as(estimate.estimated)
        errors, counted = joint_errors(estimate, Truth(points, valid), "relative")
        number = counted.sum(dim=-1)
        mean = torch.where(counted, errors, 0.0).sum(dim=-1) / number.clamp_min(1)
        return mean, (number > 0).flatten(1).all(dim=1) if extra else number > 0
