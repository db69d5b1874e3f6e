"""Pose normalisation (paper, section 3.1): what the scorer sees of a 3D pose."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.geometry.rotations import rotation_between
from ghpt.skeleton import BONES, JOINT, PELVIS

_LEFT = JOINT["left_shoulder"]
_RIGHT = JOINT["right_shoulder"]

Points = Float[Tensor, "*B J 3"]
Joints = Bool[Tensor, "*B J"]


def centre_on_pelvis(points: Points, estimated: Joints) -> Points:
    """Return the points with the pelvis at the origin, where missing joints are too.

    Where the pelvis is missing, the mean of the estimated joints takes its place.
    """
    weight = estimated.to(points.dtype)[..., None]
    total = (points * weight).sum(dim=-2)
    mean = total / weight.sum(dim=-2).clamp_min(1)
    has_pelvis = estimated[..., PELVIS, None]
    origin = torch.where(has_pelvis, points[..., PELVIS, :], mean)
    centred = points - origin[..., None, :]
    return torch.where(estimated[..., None], centred, 0.0)


def torso_normal_to_z(centred: Points, estimated: Joints) -> Float[Tensor, "*B 3 3"]:
    """Return the smallest rotation that brings the torso's normal to the z axis.

    The normal is that of the plane through both shoulders and the pelvis. The rotation is the
    identity where one of the three is missing or they lie on a line, and a half turn where the
    normal points to -z.
    """
    left = centred[..., _LEFT, :]
    across = centred[..., _RIGHT, :] - left
    down = centred[..., PELVIS, :] - left
    normal = torch.linalg.cross(across, down)
    shoulders = estimated[..., _LEFT] & estimated[..., _RIGHT]
    complete = shoulders & estimated[..., PELVIS]
    z = torch.tensor([0.0, 0.0, 1.0], dtype=centred.dtype, device=centred.device)
    normal = torch.where(complete[..., None], normal, z)
    return rotation_between(normal, z.expand_as(normal))


def normalised_coordinates(points: Points, estimated: Joints) -> Float[Tensor, "*B J*3"]:
    """Return pelvis-centred, rotated coordinates in mm, flattened; 0 for missing joints."""
    centred = centre_on_pelvis(points, estimated)
    rotation = torso_normal_to_z(centred, estimated)
    return (centred @ rotation.mT).flatten(-2)


def bone_lengths(points: Points, estimated: Joints) -> Float[Tensor, "*B L"]:
    """Return the lengths (mm) of the 16 bones; 0 where an end is missing."""
    start = [a for a, _ in BONES]
    end = [b for _, b in BONES]
    length = (points[..., start, :] - points[..., end, :]).norm(dim=-1)
    complete = estimated[..., start] & estimated[..., end]
    return torch.where(complete, length, 0.0)
