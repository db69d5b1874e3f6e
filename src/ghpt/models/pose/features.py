"""Pose normalisation (paper, section 3.1): what the scorer sees of a 3D pose."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.geometry.rotations import rotation_between
from ghpt.skeleton import BONES, JOINT, PELVIS

_LEFT = JOINT["left_shoulder"]
_RIGHT = JOINT["right_shoulder"]


def centre_on_pelvis(
    points: Float[Tensor, "*B J 3"], estimated: Bool[Tensor, "*B J"]
) -> Float[Tensor, "*B J 3"]:
    """Move the pelvis, or the mean of the estimated joints where it is missing, to the origin;
    missing joints too.
    """
    weight = estimated.to(points.dtype)[..., None]
    mean = (points * weight).sum(dim=-2) / weight.sum(dim=-2).clamp_min(1)
    origin = torch.where(estimated[..., PELVIS, None], points[..., PELVIS, :], mean)
    return torch.where(estimated[..., None], points - origin[..., None, :], 0.0)


def torso_normal_to_z(
    centred: Float[Tensor, "*B J 3"], estimated: Bool[Tensor, "*B J"]
) -> Float[Tensor, "*B 3 3"]:
    """The smallest rotation that brings the normal of the plane through both shoulders and the
    pelvis to the z axis.

    Identity where one of the three is missing or they lie on a line; a half turn where the normal
    points to -z.
    """
    left, right, pelvis = (centred[..., j, :] for j in (_LEFT, _RIGHT, PELVIS))
    normal = torch.linalg.cross(right - left, pelvis - left)
    complete = estimated[..., _LEFT] & estimated[..., _RIGHT] & estimated[..., PELVIS]
    z = torch.tensor([0.0, 0.0, 1.0], dtype=centred.dtype, device=centred.device)
    return rotation_between(torch.where(complete[..., None], normal, z), z.expand_as(normal))


def normalised_coordinates(
    points: Float[Tensor, "*B J 3"], estimated: Bool[Tensor, "*B J"]
) -> Float[Tensor, "*B J*3"]:
    """Pelvis-centred, rotated coordinates in mm, flattened; 0 for missing joints."""
    centred = centre_on_pelvis(points, estimated)
    return (centred @ torso_normal_to_z(centred, estimated).mT).flatten(-2)


def body_part_lengths(
    points: Float[Tensor, "*B J 3"], estimated: Bool[Tensor, "*B J"]
) -> Float[Tensor, "*B L"]:
    """Lengths (mm) of the 16 parts between adjacent joints; 0 where an end is missing."""
    a, b = (list(ends) for ends in zip(*BONES, strict=True))
    length = (points[..., a, :] - points[..., b, :]).norm(dim=-1)
    return torch.where(estimated[..., a] & estimated[..., b], length, 0.0)
