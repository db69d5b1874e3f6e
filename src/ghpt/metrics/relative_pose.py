"""Errors of an estimated relative camera pose (paper, section 4.5), one for each pair of views.

A pose maps the reference camera's frame to the target's: ``x_target = R x_ref + t``, t in mm.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.linalg import vector_norm
from torchmetrics import Metric

from ghpt.geometry.cameras import Cameras, project
from ghpt.geometry.rotations import rotation_angle
from ghpt.geometry.triangulation import triangulate


class MeanAndCoverage(NamedTuple):
    """What ``MeanError`` computes."""

    mean: Float[Tensor, ""]
    coverage: Float[Tensor, ""]
    """Share of the values that could be measured, in [0, 1]."""


Errors = Tensor | tuple[Tensor, Tensor]
"""Errors, or errors and which of them are measured."""


def rotation_deg(
    estimate: Float[Tensor, "*B 3 3"],
    truth: Float[Tensor, "*B 3 3"],
) -> Float[Tensor, "*B"]:
    """Return the angle of the rotation between the two, degrees in [0, 180]."""
    return torch.rad2deg(rotation_angle(estimate, truth))


def quaternion_error(
    estimate: Float[Tensor, "*B 3 3"],
    truth: Float[Tensor, "*B 3 3"],
) -> Float[Tensor, "*B"]:
    """Return E_R = |quat(R) - quat(R*)|, the signs chosen so that the quaternions are nearest.

    That equals the difference of the quaternions with w >= 0, except where both rotate by almost
    180 degrees: there the two signs may differ, and a tiny error would count as 2. With a the angle
    between R and R*, it is 2 sin(a / 4).
    """
    return 2 * torch.sin(rotation_angle(estimate, truth) / 4)


def translation_error(
    estimate: Float[Tensor, "*B 3"],
    truth: Float[Tensor, "*B 3"],
) -> Float[Tensor, "*B"]:
    """Return E_t = |t - t*|, mm."""
    return vector_norm(estimate.double() - truth.double(), dim=-1)


def translation_deg(
    estimate: Float[Tensor, "*B 3"],
    truth: Float[Tensor, "*B 3"],
) -> Float[Tensor, "*B"]:
    """Return the angle between the two directions, degrees in [0, 180].

    It is what is known when the scale is not.
    """
    estimate = estimate.double()
    truth = truth.double()
    cross = torch.linalg.cross(estimate, truth)
    cosine = (estimate * truth).sum(-1)
    return torch.rad2deg(torch.atan2(vector_norm(cross, dim=-1), cosine))


def error_2d(
    estimate: Cameras,
    truth: Cameras,
    points: Float[Tensor, "*B N 3"],
) -> tuple[Float[Tensor, "*B N"], Bool[Tensor, "*B N"]]:
    """Return E_2D, pixels, and which points are measured.

    It is the distance between the images of a point X* in the estimated and in the true target
    camera. ``estimate`` and ``truth`` are pairs (V = 2): the reference camera, then the target
    camera. A point is measured if it is in front of both targets; the error of others is 0.
    """
    pixels, depth = project(estimate, points)
    true_pixels, true_depth = project(truth, points)
    in_front = depth[..., 1, :] > 0
    truly_in_front = true_depth[..., 1, :] > 0
    measured = in_front & truly_in_front
    offset = (pixels - true_pixels)[..., 1, :, :]
    distance = vector_norm(offset, dim=-1)
    return torch.where(measured, distance, 0.0), measured


def error_3d(
    estimate: Cameras,
    truth: Cameras,
    points: Float[Tensor, "*B N 3"],
) -> tuple[Float[Tensor, "*B N"], Bool[Tensor, "*B N"]]:
    """Return E_3D, mm (paper, eq. reprojection-3d-error), and which points are measured.

    It is the distance between a point X* and what the estimated pair makes of its true images: X*
    is projected by the *true* cameras and triangulated by the *estimated* ones. The paper's words
    project with the estimated target camera and triangulate with the same one, which gives back X*
    whatever the estimate is, so one of the two must be the true camera; this choice is what a user
    meets, whose key points come from the real cameras and whose 3D comes from the estimate.

    Pairs are as in ``error_2d``. A point is measured if it is in front of the true cameras and the
    estimated pair determines it (``triangulate``'s ``ok``); the error of others is 0.
    """
    pixels, depth = project(truth, points)
    result = triangulate(estimate, pixels, torch.ones_like(depth))
    measured = (depth > 0).all(-2) & result.ok
    distance = vector_norm(result.points - points, dim=-1)
    return torch.where(measured, distance, 0.0), measured


class MeanError(Metric):
    """The mean of one of this module's errors over all that was added.

    It is a float64 sum and exact counts.
    """

    full_state_update = False
    error_sum: Tensor
    measured: Tensor
    total: Tensor

    def __init__(self, error: Callable[..., Errors]) -> None:
        super().__init__()
        self.error = error
        for state in ("error_sum", "measured", "total"):
            zero = torch.zeros((), dtype=torch.float64)
            self.add_state(state, zero, dist_reduce_fx="sum")

    def update(self, *arguments: Tensor | Cameras) -> None:
        """Add the errors of ``error(*arguments)``."""
        result = self.error(*arguments)
        if isinstance(result, tuple):
            errors, measured = result
        else:
            errors = result
            measured = torch.ones_like(errors, dtype=torch.bool)
        self.error_sum += torch.where(measured, errors, 0.0).double().sum()
        self.measured += measured.sum()
        self.total += measured.numel()

    def compute(self) -> MeanAndCoverage:
        """Return the mean and the coverage; NaN when nothing was added."""
        mean = self.error_sum / self.measured
        return MeanAndCoverage(mean, self.measured / self.total)
