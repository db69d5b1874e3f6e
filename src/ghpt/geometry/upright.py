"""A world with a floor and an upward axis, from the people who stand in it."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.geometry.cameras import Cameras
from ghpt.geometry.similarity import Similarity
from ghpt.skeleton import JOINT, PELVIS, THORAX

ANKLES = (JOINT["left_ankle"], JOINT["right_ankle"])
_LEGS = tuple(
    tuple(JOINT[f"{side}_{part}"] for part in ("hip", "knee", "ankle"))
    for side in ("left", "right")
)
_SEGMENTS = (
    ("pelvis", "thorax", 0.5, 0.497),
    ("thorax", "head_top", 0.5, 0.081),
    *(
        (f"{side}_{start}", f"{side}_{end}", along, mass)
        for side in ("left", "right")
        for start, end, along, mass in (
            ("shoulder", "elbow", 0.44, 0.028),
            ("elbow", "wrist", 0.68, 0.022),
            ("hip", "knee", 0.43, 0.1),
            ("knee", "ankle", 0.61, 0.061),
        )
    ),
)
"""Both ends of a part of the body, where its centre is between them, and its share of the mass
(Winter, Biomechanics and Motor Control of Human Movement, table 4.1; hands and feet with their
limbs, the head and neck to the top of the head).
"""
_MOST_MASS = 0.6
"""Share of the body whose centre is taken for that of the whole."""
_STRAIGHT = 0.8
"""Distance from hip to ankle in leg lengths, from which on a leg carries a person who stands."""
_FOREFOOT = 0.035
"""Leg lengths: how far before the ankles the weight rests."""
_LOWEST = 0.05
"""The quantile of the heights of the feet that is the floor: lower are errors."""
_STANDING = 0.1
"""Share of the feet's positions that are taken to lie below a plane through those on the floor."""
_LEAN = 0.06
"""Radians (3.4 degrees): how far the direction in which people stand is from the vertical."""
_UNEVEN = 15.0
"""mm: how far feet that stand on a floor are from a plane, heel or toe."""
_ROUNDS = 30
_STANCES = (10.0, 0.3, 0.07, 0.07)
"""Of each time that the lower foot is looked for by a better vertical; at first both carry."""


def upright(
    points: Float[Tensor, "T J 3"],
    estimated: Bool[Tensor, "T J"],
    cameras: Cameras,
    feet: Float[Tensor, "N 3"] | None = None,
) -> Similarity:
    """Return the way to a world with z up, the floor at 0, the origin below where the people mostly
    are, and x where the first camera looks. mm.

    ``points`` are the 17 joints of T poses, ``feet`` points that now and then stand on the floor;
    None: the ankles. z is the people's mean direction from the feet that carry them to the centre
    of their mass, or from hips to neck of who does not stand, which leans by some degrees, as far
    as the plane through the lowest feet does not say better: it does along a path of more than some
    20 cm.
    """
    if feet is None:
        ankles = list(ANKLES)
        feet = points[:, ankles][estimated[:, ankles]]
    axes = _axes(_upward(points, estimated, cameras), cameras)
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


def _upward(
    points: Float[Tensor, "T J 3"], estimated: Bool[Tensor, "T J"], cameras: Cameras
) -> Float[Tensor, " 3"]:
    """Return the mean direction in which people stand; up in the first image where nobody does."""
    points = points.double()
    trunk = points[:, THORAX] - points[:, PELVIS]
    has_trunk = estimated[:, THORAX] & estimated[:, PELVIS]
    up = _mean_direction(trunk, has_trunk)
    if float(up.norm()) == 0:
        up = -cameras.R[0, 1].double()
    centre, has_centre = centre_of_mass(points, estimated)
    for stance in _STANCES:
        feet, stands = _carrying_feet(points, estimated, up, stance)
        stands &= has_centre
        direction = torch.where(stands[:, None], centre - feet, trunk)
        found = _mean_direction(direction, stands | has_trunk)
        if float(found.norm()) == 0:
            break
        up = _unit(found)
    return up


def _mean_direction(
    vectors: Float[Tensor, "T 3"], known: Bool[Tensor, " T"]
) -> Float[Tensor, " 3"]:
    return torch.nn.functional.normalize(vectors[known], dim=-1).sum(0)


def centre_of_mass(
    points: Float[Tensor, "T J 3"], estimated: Bool[Tensor, "T J"]
) -> tuple[Float[Tensor, "T 3"], Bool[Tensor, " T"]]:
    """Return the centre of the parts of the body that are estimated, and whether most are."""
    total = torch.zeros_like(points[:, 0])
    mass = torch.zeros_like(points[:, 0, :1])
    for start, end, along, share in _SEGMENTS:
        ends = [JOINT[start], JOINT[end]]
        known = estimated[:, ends].all(-1, keepdim=True)
        centre = torch.lerp(points[:, ends[0]], points[:, ends[1]], along)
        total += torch.where(known, share * centre, 0.0)
        mass += share * known
    return total / mass.clamp(min=1e-9), mass[:, 0] >= _MOST_MASS


def _carrying_feet(
    points: Float[Tensor, "T J 3"],
    estimated: Bool[Tensor, "T J"],
    up: Float[Tensor, " 3"],
    stance: float,
) -> tuple[Float[Tensor, "T 3"], Bool[Tensor, " T"]]:
    """Return where the weight of people rests, on the lower ankle or between both, and who stands:
    the leg that carries is nearly straight. ``stance``: leg lengths; a foot that is so much higher
    than the other carries 27 % of the weight.
    """
    ankles = points[:, list(ANKLES)]
    height = ankles @ up
    legs = points[:, torch.tensor(_LEGS)]
    length = legs.diff(dim=2).norm(dim=-1).sum(-1)
    unit = length.mean(-1, keepdim=True).clamp(min=1e-9)
    share = torch.softmax(-height / (stance * unit), dim=-1)
    straight = (legs[:, :, 2] - legs[:, :, 0]).norm(dim=-1) > _STRAIGHT * length
    carrying = straight.gather(1, share.argmax(1, keepdim=True))[:, 0]
    whole = estimated[:, torch.tensor(_LEGS).flatten()].all(-1)
    aside = points[:, _LEGS[0][0]] - points[:, _LEGS[1][0]]
    ahead = torch.nn.functional.normalize(torch.linalg.cross(aside, up.expand_as(aside)), dim=-1)
    return (share[..., None] * ankles).sum(1) + _FOREFOOT * unit * ahead, whole & carrying


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
