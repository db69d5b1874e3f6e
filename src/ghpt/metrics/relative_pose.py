"""Errors of an estimated relative camera pose (paper, section 4.5), one number for each pair of
views.

A pose maps the reference camera's frame to the target's: ``x_target = R x_ref + t``, t in mm.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torchmetrics import Metric

from ghpt.geometry.cameras import Cameras, project
from ghpt.geometry.triangulation import triangulate


class MeanAndCoverage(NamedTuple):
    """What ``MeanError`` computes."""

    mean: Float[Tensor, ""]
    coverage: Float[Tensor, ""]
    """Share of the values that could be measured, in [0, 1]."""


def _angle(cross: Float[Tensor, "*B 3"], cosine: Float[Tensor, "*B"]) -> Float[Tensor, "*B"]:
    # acos loses half of the digits at 0 and 180 degrees; atan2 none.
    return torch.atan2(torch.linalg.vector_norm(cross, dim=-1), cosine)


def _rotation_angle(
    estimate: Float[Tensor, "*B 3 3"], truth: Float[Tensor, "*B 3 3"]
) -> Float[Tensor, "*B"]:
    difference = estimate.double() @ truth.double().mT
    skew = (difference - difference.mT) / 2
    axis = torch.stack((skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]), dim=-1)
    return _angle(axis, (difference.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2)


def rotation_deg(
    estimate: Float[Tensor, "*B 3 3"], truth: Float[Tensor, "*B 3 3"]
) -> Float[Tensor, "*B"]:
    """Angle of the rotation between the two, degrees in [0, 180]."""
    return torch.rad2deg(_rotation_angle(estimate, truth))


def quaternion_error(
    estimate: Float[Tensor, "*B 3 3"], truth: Float[Tensor, "*B 3 3"]
) -> Float[Tensor, "*B"]:
    """E_R = |quat(R) - quat(R*)|, with the signs of the quaternions chosen so that they are
    nearest.

    That equals the difference of the quaternions with w >= 0, except where both turn by almost 180
    degrees: there the two signs may differ, and a tiny error would count as 2. With a the angle
    between R and R*, it is 2 sin(a / 4).
    """
    return 2 * torch.sin(_rotation_angle(estimate, truth) / 4)


def translation_error(
    estimate: Float[Tensor, "*B 3"], truth: Float[Tensor, "*B 3"]
) -> Float[Tensor, "*B"]:
    """E_t = |t - t*|, mm."""
    return torch.linalg.vector_norm(estimate.double() - truth.double(), dim=-1)


def translation_deg(
    estimate: Float[Tensor, "*B 3"], truth: Float[Tensor, "*B 3"]
) -> Float[Tensor, "*B"]:
    """Angle between the directions of the two, degrees in [0, 180]: what is known when the scale is
    not.
    """
    estimate = estimate.double()
    truth = truth.double()
    return torch.rad2deg(_angle(torch.linalg.cross(estimate, truth), (estimate * truth).sum(-1)))


def error_2d(
    estimate: Cameras, truth: Cameras, points: Float[Tensor, "*B N 3"]
) -> tuple[Float[Tensor, "*B N"], Bool[Tensor, "*B N"]]:
    """E_2D, pixels: distance between a point X* as the estimated and as the true target camera see
    it.

    ``estimate`` and ``truth`` are pairs (V = 2): the reference camera, then the target camera. A
    point counts if it is in front of both targets; one that does not has error 0.
    """
    (pixels, depth) = project(estimate, points)
    (true_pixels, true_depth) = project(truth, points)
    counted = (depth[..., 1, :] > 0) & (true_depth[..., 1, :] > 0)
    distance = torch.linalg.vector_norm((pixels - true_pixels)[..., 1, :, :], dim=-1)
    return torch.where(counted, distance, 0.0), counted


def error_3d(
    estimate: Cameras, truth: Cameras, points: Float[Tensor, "*B N 3"]
) -> tuple[Float[Tensor, "*B N"], Bool[Tensor, "*B N"]]:
    """E_3D, mm (paper, eq. reprojection-3d-error): distance between a point X* and what the
    estimated pair makes of its true images.

    X* is projected by the *true* cameras and triangulated by the *estimated* ones. The paper's
    words project with the estimated target camera and triangulate with the same one, which gives
    back X* whatever the estimate is, so one of the two must be the true camera; this choice is what
    a user meets, whose key points come from the real cameras and whose 3D comes from the estimate.

    Pairs are as in ``error_2d``. A point counts if it is in front of the true cameras and the
    estimated pair determines it (``triangulate``'s ``ok``); one that does not has error 0.
    """
    pixels, depth = project(truth, points)
    result = triangulate(estimate, pixels, torch.ones_like(depth))
    counted = (depth > 0).all(-2) & result.ok
    return torch.where(
        counted, torch.linalg.vector_norm(result.points - points, dim=-1), 0.0
    ), counted


class MeanError(Metric):
    """The mean of one of this module's errors over all that was added: a float64 sum and exact
    counts.
    """

    full_state_update = False
    error_sum: Tensor
    counted: Tensor
    offered: Tensor

    def __init__(self, error: Callable[..., Tensor | tuple[Tensor, Tensor]]) -> None:
        super().__init__()
        self.error = error
        for state in ("error_sum", "counted", "offered"):
            self.add_state(state, torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, *arguments: Tensor | Cameras) -> None:
        """Add the errors of ``error(*arguments)``."""
        result = self.error(*arguments)
        errors, counted = (
            result
            if isinstance(result, tuple)
            else (result, torch.ones_like(result, dtype=torch.bool))
        )
        self.error_sum += torch.where(counted, errors, 0.0).double().sum()
        self.counted += counted.sum()
        self.offered += counted.numel()

    def compute(self) -> MeanAndCoverage:
        """NaN when nothing was added."""
        return MeanAndCoverage(self.error_sum / self.counted, self.counted / self.offered)
