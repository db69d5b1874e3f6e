"""Frames by learned key-point weights: one triangulation of each joint, by weights that ship."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from ghpt.errors import check
from ghpt.geometry.triangulation import Triangulation, concatenate
from ghpt.models.estimators.classical import Estimator
from ghpt.models.estimators.predictors import observe_joints
from ghpt.models.key_points.problem import KeyPoints, KeyPointWeights
from ghpt.models.weights import load_shipped
from ghpt.observations import Observations, PoseEstimate
from ghpt.skeleton import HUMAN36M, JOINT, JOINTS, Skeleton

_PAIRS_AT_ONCE = 2**18
"""Pairs of key points of one joint that are looked at together."""


@dataclass(frozen=True)
class FrameLearned(Estimator):
    """Weights each key point by a small network that sees how it stands beside the others.

    ``weights``: of a model of ``ghpt/weights``. The first estimate is that of the model's own
    AdaptiveRansac, which also stands where the weights leave a joint without a point; a view counts
    as one that made a joint as it does there.

    ``trust``: in a frame whose views disagree as a whole (cameras that are off, much noise) the
    logits are multiplied by the smallest threshold of RANSAC over that of the frame, to this power:
    what a network says of single views is worth little there. 0: they never are.

    The network knows the 17 joints, which are means of the ``skeleton``'s key points in the images.
    Those of them that are key points themselves are its own; all others have the first estimate.
    """

    sort = "by weights that come with ghpt"

    weights: str
    trust: float
    skeleton: Skeleton = HUMAN36M

    def __post_init__(self) -> None:
        check(self.trust >= 0, "trust", f"is {self.trust}", "It must be >= 0.")

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
        model = load_shipped(self.weights)
        problem = self._problem
        start = problem.start.triangulate(batch)
        key_points = KeyPoints(batch, PoseEstimate(start.points, start.has_position))
        logits = model.scorer(problem.featurize(key_points))
        threshold = problem.start.inlier_threshold(batch, start.points)
        trust = (problem.start.threshold / threshold) ** self.trust
        weights = (logits * trust[:, None]).softmax(dim=-1)
        result = problem.triangulate(key_points, weights)
        return result.with_fallback(result.ok, start)

    def inlier_threshold(
        self, batch: Observations, points: Float[Tensor, "B J 3"]
    ) -> Float[Tensor, " B"]:
        return self._problem.start.inlier_threshold(batch, points)

    @property
    def _problem(self) -> KeyPointWeights:
        problem = load_shipped(self.weights).problem
        if not isinstance(problem, KeyPointWeights):
            raise TypeError(f"{self.weights} are no weights of key points")
        return problem
