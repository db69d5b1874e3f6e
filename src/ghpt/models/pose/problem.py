"""The pose problem (paper, section 3.1): a hypothesis triangulates each joint from its own random
subset of views.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.config import build
from ghpt.data.datasets.frames import Frames
from ghpt.errors import check
from ghpt.extras import build_installed
from ghpt.geometry.subsets import random_subsets
from ghpt.geometry.triangulation import triangulate, triangulate_subsets
from ghpt.metrics.pose_error import joint_errors
from ghpt.models.measured import Measured
from ghpt.models.pose.evaluation import evaluate_poses
from ghpt.models.pose.features import bone_lengths, normalised_coordinates
from ghpt.models.pose.numbers import PoseNumbers
from ghpt.models.pose.schema import POSES, PosePredictions, PoseSample, PoseTables
from ghpt.models.predictions import with_nan
from ghpt.models.problem import (
    BaselineSettings,
    Errors,
    Features,
    Hypotheses,
    Keys,
    Problem,
    Weights,
)
from ghpt.observations import Labelled, Observations, PoseEstimate, Truth
from ghpt.report.report import Report
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


class PoseProblem(Problem):
    """What all problems share that estimate poses: they are compared by MPJPE."""

    measures = "MPJPE relative to the pelvis"
    schema = POSES

    def error(self, estimate: PoseEstimate, truth: Truth) -> Errors:
        """Return the pelvis-relative MPJPE (eq:mpjpe), mm, and which frames can be compared.

        The joints that count are estimated and have a truth.
        """
        extra = (None,) * (estimate.points.dim() - 3)
        points = truth.points[:, *extra].expand_as(estimate.points)
        valid = truth.valid[:, *extra].expand_as(estimate.estimated)
        errors, counted = joint_errors(estimate, Truth(points, valid), "relative")
        number = counted.sum(dim=-1)
        total = torch.where(counted, errors, 0.0).sum(dim=-1)
        has_truth = (number > 0).flatten(1).all(dim=1) if extra else number > 0
        return total / number.clamp_min(1), has_truth

    def baselines(
        self, settings: BaselineSettings, model: Any
    ) -> Mapping[str, Callable[[Observations], PoseEstimate]]:
        """Return trajectories, where there are settings for them, and the rest."""
        others: dict[str, Callable[[Observations], PoseEstimate]] = {}
        if settings.trajectory:
            others["trajectory"] = build(settings.trajectory, "trajectory")
        return others | build_installed(settings.baselines, "baselines")

    def record(self, batch: Labelled[Observations, Truth], dataset: Frames) -> PoseSample:
        """Return the frames' true poses, recordings and numbers."""
        observations = batch.observations
        frame = torch.from_numpy(dataset.frame_numbers(observations.index.tolist()))
        truth = batch.truth
        return PoseSample(with_nan(truth), truth.valid, observations.recording, frame)

    def tables(self, dataset: Frames) -> PoseTables:
        """Return the recordings."""
        return PoseTables.from_recordings(dataset.recordings)

    def metrics(self, predictions: PosePredictions) -> Measured[PoseNumbers]:
        """Return what a test run measured."""
        return evaluate_poses(predictions)

    def report(self) -> Report:
        """Return the tables and figures; imported here, since drawing is slow to import."""
        from ghpt.report.tensorboard import REPORT

        return REPORT


class PoseTriangulation(PoseProblem):
    """3D poses, each triangulated from random views; compared by MPJPE.

    ``coordinates`` and ``lengths``: whether the scorer sees the normalised coordinates, and the
    lengths of the bones.
    """

    def __init__(self, coordinates: bool, lengths: bool) -> None:
        problem = "neither coordinates nor lengths is on"
        hint = "Switch on at least one kind of features."
        check(coordinates or lengths, "model.problem", problem, hint)
        self.coordinates = coordinates
        self.lengths = lengths
        self.feature_size = len(JOINTS) * 3 * coordinates + len(BONES) * lengths

    @torch.no_grad()
    def generate(self, observations: Observations, count: int, keys: Keys) -> PoseHypotheses:
        """Triangulate each joint from a uniformly random subset of at least two valid views.

        Where a subset is degenerate (parallel rays, a point behind a camera), all valid views stand
        in for it, so that every hypothesis has every joint that the frame determines.
        """
        cameras = observations.cameras
        key_points = observations.key_points
        valid = observations.valid
        whole = triangulate(cameras, key_points, valid.double())
        views = random_subsets(valid, count, keys)
        points, ok = triangulate_subsets(cameras, key_points, valid, views)
        points = torch.where(ok[..., None], points, whole.points[:, None])
        views = torch.where(ok[..., None], views, valid.mT[:, None])
        return PoseHypotheses(points.float(), views, whole.ok)

    @torch.no_grad()
    def featurize(self, hypotheses: PoseHypotheses) -> Features:
        """Return normalised coordinates and bone lengths, mm."""
        points = hypotheses.points
        estimated = hypotheses.estimated[:, None].expand(points.shape[:-1])
        features = []
        if self.coordinates:
            features.append(normalised_coordinates(points, estimated))
        if self.lengths:
            features.append(bone_lengths(points, estimated))
        return torch.cat(features, dim=-1)

    def aggregate(self, hypotheses: PoseHypotheses, weights: Weights) -> PoseEstimate:
        """Return the weighted average of the poses.

        It is taken about the pool's mean, so that float32 keeps its digits.
        """
        points = hypotheses.points
        centre = points.mean(dim=1, keepdim=True)
        weights = weights.to(centre.dtype)
        offset = torch.einsum("bh,bhjc->bjc", weights, points - centre)
        return PoseEstimate(centre[:, 0] + offset, hypotheses.estimated)

    def as_estimates(self, hypotheses: PoseHypotheses) -> PoseEstimate:
        """Return all hypotheses as estimates with leading dimensions B H."""
        points = hypotheses.points
        estimated = hypotheses.estimated[:, None].expand(points.shape[:-1])
        return PoseEstimate(points, estimated)
