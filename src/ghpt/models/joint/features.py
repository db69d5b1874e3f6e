"""What is seen of each hypothesis of a joint: 3D alone, in the pose around it.

Lengths are in units of half a percent of the person's stature (``ghpt.models.body``)
and directions in the trunk's frame, so that all people, cameras and worlds compare.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.models.body import BONE_SHARES, UNIT, log_length, stature, trunk_axes
from ghpt.observations import PoseEstimate
from ghpt.skeleton import BONES, JOINTS

RANKS = (2, 5, 8, 12)
"""The neighbours of a hypothesis among the others of its joint whose distances are seen."""
_ENDS = 4
"""The most bones that meet in a joint."""
SIZE = 16 + len(RANKS) + 2 * _ENDS + 3 * len(JOINTS)
"""D, the number of features."""

Points = Float[Tensor, "B S J 3"]
PerHypothesis = Float[Tensor, "B S J"]


@torch.no_grad()
def featurize(points: Points, context: PoseEstimate) -> Float[Tensor, "B S J D"]:
    """Return the features of S hypotheses of each joint beside the pose ``context``.

    They are 0 for joints that are not estimated; the first is 1 for the others.
    """
    estimated = context.estimated
    count = estimated.sum(-1).clamp(min=1)[:, None]
    world = torch.where(estimated[..., None], context.points.double(), 0.0)
    origin = world.sum(1) / count
    pose = torch.where(estimated[..., None], world - origin[:, None], 0.0).float()
    local = (points.double() - origin[:, None, None]).float()
    unit = UNIT * stature(pose, estimated)
    axes, known = trunk_axes(pose, estimated)
    axes = torch.where(known[:, None, None], axes, torch.eye(3, device=axes.device))
    moved = (local - pose[:, None]) @ axes.mT[:, None] / unit[:, None, None, None]
    common = _common(moved, estimated)
    own = moved - common
    features = [
        torch.ones_like(moved[..., 0]),
        *_signed_log(moved).unbind(-1),
        log_length(moved.norm(dim=-1)),
        *_signed_log(own).unbind(-1),
        log_length(own.norm(dim=-1)),
        *_signed_log(common).expand_as(moved).unbind(-1),
        log_length(common.norm(dim=-1)).expand(moved.shape[:-1]),
        *_crowd(moved),
        *_bones(local, pose, estimated, unit),
        _is_context(moved),
    ]
    around = (3 * UNIT * (pose @ axes.mT) / unit[:, None, None]).flatten(1)
    everywhere = around[:, None, None].expand(*moved.shape[:-1], -1)
    stacked = torch.cat((torch.stack(features, dim=-1), everywhere), dim=-1)
    return torch.where(estimated[:, None, :, None], stacked, 0.0)


def _signed_log(length: Tensor) -> Tensor:
    """Return sign(length) log(1 + |length|)."""
    return length.sign() * (length.abs() + 1).log()


def _common(
    moved: Float[Tensor, "B S J 3"], estimated: Bool[Tensor, "B J"]
) -> Float[Tensor, "B S 1 3"]:
    """Return the median over the joints of how far a hypothesis is from the context.

    It is what cameras that are not where they are said to be do to all joints alike.
    """
    masked = torch.where(estimated[:, None, :, None], moved, torch.nan)
    return masked.nanmedian(2, keepdim=True).values.nan_to_num(0.0)


def _crowd(moved: Float[Tensor, "B S J 3"]) -> list[PerHypothesis]:
    """Return how far each hypothesis is from the others of its joint.

    Logarithms of the distances from the ``RANKS``-th nearest and from the median of all, and the
    median distance from the mean.
    """
    joints_first = moved.transpose(1, 2)
    near = torch.cdist(joints_first, joints_first).sort(-1).values.transpose(1, 2)
    ranked = [log_length(near[..., min(rank, near.shape[-1] - 1)]) for rank in RANKS]
    off = log_length((moved - moved.median(1, keepdim=True).values).norm(dim=-1))
    distance = (moved - moved.mean(1, keepdim=True)).norm(dim=-1)
    spread = log_length(distance.median(1, keepdim=True).values)
    return [*ranked, off, spread.expand_as(off)]


def _bones(
    local: Points,
    pose: Float[Tensor, "B J 3"],
    estimated: Bool[Tensor, "B J"],
    unit: Float[Tensor, " B"],
) -> list[PerHypothesis]:
    """Return by how much the bones from each joint to the context's are too long.

    First those of the hypotheses, then those of the context; 0 where a joint has no such bone.
    """
    shares = local.new_tensor(BONE_SHARES)
    of_hypotheses = []
    of_context = []
    for ends in _ENDS_OF_JOINTS:
        other = [end for end, _ in ends]
        expected = shares[[bone for _, bone in ends]] / UNIT
        exists = torch.tensor([end != joint for joint, end in enumerate(other)])
        known = estimated[:, other] & exists.to(estimated.device)
        length = (local - pose[:, None, other]).norm(dim=-1) / unit[:, None, None]
        own = (pose - pose[:, other]).norm(dim=-1) / unit[:, None]
        of_hypotheses.append(torch.where(known[:, None], _signed_log(length - expected), 0.0))
        excess = torch.where(known, _signed_log(own - expected), 0.0)
        of_context.append(excess[:, None].expand_as(length))
    return [*of_hypotheses, *of_context]


def _is_context(moved: Float[Tensor, "B S J 3"]) -> PerHypothesis:
    """Return 1 for the first hypothesis, which is the context itself, 0 for the others."""
    first = torch.zeros_like(moved[..., 0])
    first[:, 0] = 1.0
    return first


def _ends_of_joints() -> tuple[tuple[tuple[int, int], ...], ...]:
    """Return for k = 0 to 3 the other end and the number of each joint's k-th bone.

    A joint that has fewer bones has itself as the other end.
    """
    bones: list[list[tuple[int, int]]] = [[] for _ in JOINTS]
    for number, (start, end) in enumerate(BONES):
        bones[start].append((end, number))
        bones[end].append((start, number))
    padded = [[*own, *[(joint, 0)] * (_ENDS - len(own))] for joint, own in enumerate(bones)]
    return tuple(zip(*padded, strict=True))


_ENDS_OF_JOINTS = _ends_of_joints()
