"""A world with a floor and an upward axis, from the people who stand in it."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.geometry.cameras import Cameras
from ghpt.geometry.similarity import Similarity
from ghpt.skeleton import JOINT, PELVIS, THORAX

ANKLES = (JOINT["left_ankle"], JOINT["right_ankle"])
_LOWEST = 0.05
"""The quantile of the heights of the feet that is the floor: lower are errors."""
_STANDING = 0.1
"""Share of the feet's positions that are taken to lie below a plane through those on the floor."""
_LEAN = 0.087
"""Radians (5 degrees): how far people's mean direction from hips to neck is from the vertical."""
_UNEVEN = 15.0
"""mm: how far feet that stand on a floor are from a plane, heel or toe."""
_ROUNDS = 30


def upright(
    points: Float[Tensor, "T J 3"],
    estimated: Bool[Tensor, "T J"],
    cameras: Cameras,
    feet: Float[Tensor, "N 3"] | None = None,
) -> Similarity:
    """Return the way to a world with z up, the floor at 0, the origin below where the people mostly
    are, and x where the first camera looks. mm.

    ``points`` are the 17 joints of T poses, ``feet`` points that now and then stand on the floor;
    None: the ankles. z is the people's mean direction from hips to neck, which leans by some 5
    degrees, as far as the plane through the lowest feet does not say better: it does along a path
    of more than some 20 cm.
    """
    if feet is None:
        ankles = list(ANKLES)
        feet = points[:, ankles][estimated[:, ankles]]
    axes = _axes(_trunk_direction(points, estimated, cameras), cameras)
    if len(feet):
        normal = _floor_normal(feet.to(axes.dtype) @ axes.mT)
        axes = _axes(normal @ axes, cameras)
    positions = points[estimated] @ axes.mT
    if not len(positions):
        return Similarity(axes, 1.0, torch.zeros(3, dtype=axes.dtype))
    middle = positions.median(0).values
    lowest = feet.to(axes.dtype) @ axes.mT if len(feet) else positions
    floor = lowest[:, 2].quantile(_LOWEST)
    return Similarity(axes, 1.0, -torch.stack((middle[0], middle[1], floor)))


def _axes(z: Float[Tensor, " 3"], cameras: Cameras) -> Float[Tensor, "3 3"]:
    """Return the rotation to axes with this z, and x where the first camera looks."""
    z = _unit(z)
    forward = _across(cameras.R[0, 2], z)
    if float(forward.norm()) <= 1e-3:  # the first camera looks straight down
        forward = _across(cameras.R[0, 0], z)
    x = _unit(forward)
    return torch.stack((x, torch.linalg.cross(z, x), z))


def _trunk_direction(
    points: Float[Tensor, "T J 3"], estimated: Bool[Tensor, "T J"], cameras: Cameras
) -> Float[Tensor, " 3"]:
    both = estimated[:, THORAX] & estimated[:, PELVIS]
    trunk = (points[:, THORAX] - points[:, PELVIS])[both]
    direction = torch.nn.functional.normalize(trunk, dim=-1).sum(0)
    return direction if float(direction.norm()) > 0 else -cameras.R[0, 1]


def _floor_normal(feet: Float[Tensor, "N 3"]) -> Float[Tensor, " 3"]:
    """Return the normal of the plane under feet whose z is nearly up.

    It is the regression of height on position for the quantile ``_STANDING``, by reweighted least
    squares, with the slopes' deviation of ``_LEAN`` as the prior of a measurement of ``_UNEVEN``.
    """
    prior = (_UNEVEN / _LEAN) ** 2 * torch.eye(2, dtype=feet.dtype)
    weight = torch.ones_like(feet[:, 2])
    slope = feet.new_zeros(2)
    for _ in range(_ROUNDS):
        share = (weight / weight.sum())[:, None]
        offset = feet - (share * feet).sum(0)
        across = offset[:, :2]
        moment = (share * across).mT @ offset
        slope = torch.linalg.solve(moment[:, :2] + prior, moment[:, 2])
        height = feet[:, 2] - feet[:, :2] @ slope
        residual = height - height.quantile(_STANDING)
        side = torch.where(residual > 0, _STANDING, 1 - _STANDING)
        weight = side / residual.abs().clamp(min=_UNEVEN)
    return torch.cat((-slope, slope.new_ones(1)))


def _across(v: Float[Tensor, " 3"], axis: Float[Tensor, " 3"]) -> Float[Tensor, " 3"]:
    """Return the part of ``v`` that is perpendicular to the unit vector ``axis``."""
    return v - (v @ axis) * axis


def _unit(v: Float[Tensor, " 3"]) -> Float[Tensor, " 3"]:
    return v / v.norm()
