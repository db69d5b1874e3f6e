"""Joints that are means of key points, taken in 3D of what was triangulated."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ghpt.observations import PoseEstimate
from ghpt.reconstruction import Reconstruction, State
from ghpt.skeleton import HUMAN36M, JOINTS, NamePair, Skeleton


@dataclass(frozen=True)
class JointMeans:
    """The J joints that a file has, each a weighted mean of the K key points of a reconstruction.

    A key point as it is keeps all that is known of it. Of a mean of several

    1. the state is that of its worst part, so it has a position where all of its parts have one;
    2. the views are those that made any of its parts;
    3. the error is the root mean square over all views of all parts;
    4. the covariance is the weighted mean of its parts' covariances. Whatever their errors have in
       common, that of their mean is no larger: ``Cov(sum w x) <= sum w Cov(x)`` where weights sum
       to 1.

    A joint without weights has no position.
    """

    joints: tuple[str, ...]
    bones: tuple[NamePair, ...]
    """Between these joints, by name."""
    weights: tuple[tuple[float, ...], ...]
    """[J K]; the rows sum to 1, or are zeros."""

    def __call__(self, part: Reconstruction) -> Reconstruction:
        """Return the joints of a part of a reconstruction."""
        means = self._average(part)
        return part.with_joints(means).select_joints(self._places)

    def average_points(self, poses: PoseEstimate) -> PoseEstimate:
        """Return the joints of poses of key points, where all parts of a joint are estimated."""
        weights = self._matrix
        part = weights > 0
        points = torch.where(poses.estimated[..., None], poses.points.double(), 0.0)
        complete = (part & ~poses.estimated[:, None]).sum(-1) == 0
        return PoseEstimate(weights @ points, complete & part.any(-1))

    @property
    def key_point_joints(self) -> tuple[tuple[int, int], ...]:
        """Pairs of a key point and the joint that it is."""
        joints, key_points = torch.nonzero(self._matrix == 1, as_tuple=True)
        return tuple(zip(key_points.tolist(), joints.tolist(), strict=True))

    @cached_property
    def _matrix(self) -> Float[Tensor, "J K"]:
        return torch.tensor(self.weights, dtype=torch.float64)

    @cached_property
    def _places(self) -> Int[Tensor, " J"]:
        """Where each joint is among the key points, and the means behind them."""
        count = self._matrix.shape[1]
        mean = self._is_mean.cumsum(0) - 1
        return torch.where(self._is_mean, count + mean, self._matrix.argmax(-1))

    @property
    def _is_mean(self) -> Tensor:
        return (self._matrix == 1).sum(-1) == 0

    def _average(self, part: Reconstruction) -> Reconstruction:
        """Return the joints that are no key points."""
        weights = self._matrix[self._is_mean]
        most = int((self._matrix > 0).sum(-1).max())
        weight, parts = weights.topk(most, dim=-1)
        used = weight > 0
        state = torch.where(used, part.state[:, parts], int(State.OBSERVED)).amax(-1)
        state = torch.where(used.any(-1), state, int(State.FEW_VIEWS))
        count = part.views.sum(1)[:, parts] * used
        square = (count * part.error[:, parts] ** 2).sum(-1) / count.sum(-1).clamp(min=1)
        share = weight[..., None]
        return Reconstruction(
            frame=part.frame,
            points=(share * part.points[:, parts]).sum(-2),
            state=state.to(torch.int8),
            error=square.sqrt(),
            views=(part.views[:, :, parts] & used).any(-1) & (state <= State.SUPPORTED)[:, None],
            covariance=(share.float() * part.covariance[:, parts]).sum(-2),
            score=part.score,
            flipped=part.flipped,
        )


def human_joints(skeleton: Skeleton) -> JointMeans:
    """Return the 17 joints of a skeleton, in their order."""
    return JointMeans(JOINTS, HUMAN36M.bone_names, skeleton.joints)


def all_joints(skeleton: Skeleton) -> JointMeans:
    """Return the 17 joints of a skeleton, and behind them all its key points that are none of them.

    Of one that gives too few of the 17 these are its key points alone.
    """
    own = dict(zip(skeleton.key_points, torch.eye(len(skeleton)).tolist(), strict=True))
    if not skeleton.has_joints:
        return JointMeans(skeleton.key_points, skeleton.bone_names, (*map(tuple, own.values()),))
    rows = dict(zip(JOINTS, skeleton.joints, strict=True))
    added = {name: tuple(row) for name, row in own.items() if name not in rows}
    pairs = (*HUMAN36M.bone_names, *skeleton.bone_names)
    bones = {frozenset(bone): bone for bone in pairs}
    weights = (*rows.values(), *added.values())
    return JointMeans((*JOINTS, *added), tuple(bones.values()), weights)
