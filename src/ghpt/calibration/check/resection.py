"""The pose of a camera from the people that the other views give."""

from __future__ import annotations

import numpy as np
import poselib
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.calibration.check.setup import Rays
from ghpt.calibration.pairs import camera_dict, ransac_options
from ghpt.geometry.rotations import matrix_to_vector, nearest_rotation

_LEAST = 20
"""Points that a pose is fitted to."""
_ITERATIONS = 20
_SMALLEST = 1e-6
"""Radians; a residual below weighs no more."""


def resect(
    rays: Rays,
    points: Float[Tensor, "F J 3"],
    known: Bool[Tensor, "F J"],
    threshold: float,
    seed: int,
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, " 3"]] | None:
    """Return R and t of one view by PnP with LO-RANSAC; None where nothing agrees.

    An inlier's error is at most ``threshold`` sizes of the person.
    """
    used = _select_used(rays, known)
    if int(used.sum()) < _LEAST:
        return None
    typical = float(rays.size[rays.size > 0].median())
    pose, info = poselib.estimate_absolute_pose(
        (rays.xy[used] / typical).numpy(),
        points[used].numpy(),
        camera_dict(1 / typical),
        ransac_options(threshold, 1000, seed, "max_reproj_error"),
        {"loss_type": "CAUCHY", "loss_scale": threshold / 4},
    )
    R = torch.from_numpy(np.array(pose.R))
    t = torch.from_numpy(np.array(pose.t))
    finite = bool(torch.isfinite(R).all() & torch.isfinite(t).all())
    enough = sum(info["inliers"]) >= _LEAST
    return (R, t) if enough and finite else None


def equivalent_rotation(
    rays: Rays,
    points: Float[Tensor, "F J 3"],
    known: Bool[Tensor, "F J"],
    R: Float[Tensor, "3 3"],
    t: Float[Tensor, " 3"],
) -> float:
    """Return the angle (degrees) by which a camera would have to be rotated where it stands for its
    rays to meet the points: a robust fit, of the least sum of distances.
    """
    used = _select_used(rays, known)
    in_camera = points[used] @ R.mT + t
    predicted = torch.nn.functional.normalize(in_camera, dim=-1)
    homogeneous = torch.nn.functional.pad(rays.xy[used], (0, 1), value=1.0)
    observed = torch.nn.functional.normalize(homogeneous, dim=-1)
    weight = torch.ones_like(predicted[:, :1])
    rotation = torch.eye(3, dtype=R.dtype)
    for _ in range(_ITERATIONS):
        rotation = nearest_rotation((weight * observed).mT @ predicted)
        residual = observed - predicted @ rotation.mT
        weight = 1 / residual.norm(dim=-1, keepdim=True).clamp(min=_SMALLEST)
    return float(torch.rad2deg(matrix_to_vector(rotation).norm()))


def _select_used(rays: Rays, known: Bool[Tensor, "F J"]) -> Bool[Tensor, "F J"]:
    return rays.valid & known & (rays.size > 0)[:, None]
