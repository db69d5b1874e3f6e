"""Frames by two small models whose weights ship: of key points, then of joints in their pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from ghpt.errors import check_positive
from ghpt.geometry.triangulation import Triangulation, concatenate
from ghpt.models.body import stature
from ghpt.models.estimators.classical import Estimator
from ghpt.models.estimators.predictors import observe_joints
from ghpt.models.joint.problem import JointSubsets
from ghpt.models.key_points.problem import KeyPoints, KeyPointWeights
from ghpt.models.weights import load_shipped
from ghpt.observations import Observations, PoseEstimate
from ghpt.skeleton import HUMAN36M, JOINT, JOINTS, Skeleton

_PAIRS_AT_ONCE = 2**18
"""Pairs of key points of one joint that are looked at together."""


@dataclass(frozen=True)
class FrameLearned(Estimator):
    """Weights key points, and then what subsets of them make of each joint, by small networks.

    ``key_points`` and ``joints``: of ``ghpt/weights``; without ``joints`` (None) the weighted
    triangulation of the key points is the estimate. The first estimate is that of the model's own
    AdaptiveRansac, which also stands where the weights leave a joint without a point; a view counts
    as one that made a joint as it does there. Angles and conditions are those of the weighted
    triangulation.

    Where a joint of a frame moves by more than ``far`` (of the person's stature) it was a wrong
    estimate that the key points were judged beside: the frame is weighed again beside the new one,
    ``passes`` times in all at most.

    The network knows the 17 joints, which are means of the ``skeleton``'s key points in the images.
    Those of them that are key points themselves are its own; all others have the first estimate.
    """

    sort = "by weights that come with ghpt"

    key_points: str
    joints: str | None
    passes: int = 1
    far: float = 0.07
    skeleton: Skeleton = HUMAN36M

    def __post_init__(self) -> None:
        check_positive(passes=self.passes, far=self.far)

    def for_skeleton(self, skeleton: Skeleton) -> FrameLearned:
        return replace(self, skeleton=skeleton)

    def triangulate(self, batch: Observations) -> Triangulation:
        skeleton = self.skeleton
        if skeleton == HUMAN36M:
            return self._triangulate_joints(batch)
        start = self._problem.start.triangulate(batch)
        direct = [name for name in JOINTS if name in skeleton.key_points]
        if not direct or not skeleton.has_joints:
            return start
        device = batch.valid.device
        joints = torch.tensor([JOINT[name] for name in direct], device=device)
        own = torch.tensor([skeleton.key_points.index(name) for name in direct], device=device)
        learned = self._triangulate_joints(observe_joints(batch, skeleton))
        return start.with_joints(own, learned.joints(joints))

    def _triangulate_joints(self, batch: Observations) -> Triangulation:
        frames, views, joints = batch.valid.shape
        size = max(1, _PAIRS_AT_ONCE // max(views * views * joints, 1))
        starts = range(0, max(frames, 1), size)
        return concatenate([self._triangulate(batch.rows(slice(s, s + size))) for s in starts])

    @torch.no_grad()
    def _triangulate(self, batch: Observations) -> Triangulation:
        result = self._problem.start.triangulate(batch)
        rows = torch.arange(len(batch), device=batch.valid.device)
        for _ in range(self.passes):
            before = result.rows(rows)
            weighted = self._weigh(batch.rows(rows), before)
            result = result.with_rows(rows, weighted)
            rows = rows[_largest_move(before, weighted) > self.far]
            if not len(rows):
                break
        if self.joints is None:
            return result
        points = _average_subsets(self.joints, batch, result)
        return replace(result, points=points)

    def _weigh(self, batch: Observations, start: Triangulation) -> Triangulation:
        """Return the weighted triangulation of key points that are judged beside ``start``."""
        problem = self._problem
        key_points = KeyPoints(batch, PoseEstimate(start.points, start.has_position))
        logits = load_shipped(self.key_points).scorer(problem.featurize(key_points))
        result = problem.triangulate(key_points, logits.softmax(dim=-1))
        return result.with_fallback(result.ok, start)

    def inlier_threshold(
        self, batch: Observations, points: Float[Tensor, "B J 3"]
    ) -> Float[Tensor, " B"]:
        return self._problem.start.inlier_threshold(batch, points)

    @property
    def _problem(self) -> KeyPointWeights:
        problem = load_shipped(self.key_points).problem
        if not isinstance(problem, KeyPointWeights):
            raise TypeError(f"{self.key_points} are no weights of key points")
        return problem


def _largest_move(before: Triangulation, after: Triangulation) -> Float[Tensor, " B"]:
    """Return how far the joint of each frame moved that moved most, in statures."""
    placed = before.has_position
    moved = torch.where(placed, (after.points - before.points).norm(dim=-1), 0.0)
    return moved.amax(-1) / stature(after.points, placed)


def _average_subsets(
    joints: str, batch: Observations, context: Triangulation
) -> Float[Tensor, "B J 3"]:
    """Return each joint as the average of what subsets of the views make of it."""
    model = load_shipped(joints)
    problem = model.problem
    if not isinstance(problem, JointSubsets):
        raise TypeError(f"{joints} are no weights of joints")
    pose = PoseEstimate(context.points, context.has_position)
    keys = model.keys("frame_learned", batch)
    hypotheses = problem.generate_around(batch, pose, model.hypotheses, keys)
    weights = model.scorer(problem.featurize(hypotheses)).softmax(dim=-1)
    return problem.aggregate(hypotheses, weights).points
