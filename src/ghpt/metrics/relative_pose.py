"""Errors of an estimated relative camera pose (paper, section 4.5), one number for each pair of views.

A pose maps the reference camera's frame to the target's: ``x_target = R x_ref + t``, t in mm.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics import Metric

from ghpt.geometry.cameras import Cameras, project


def _angle(cross: Float[Tensor, "*B 3"], cosine: Float[Tensor, "*B"]) -> Float[Tensor, "*B"]:
    # acos loses half of the digits at 0 and 180 degrees; atan2 none.
    return torch.atan2(torch.linalg.vector_norm(cross, dim=-1), cosine)


def _rotation_angle(estimate: Float[Tensor, "*B 3 3"], truth: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B"]:
    difference = estimate.double() @ truth.double().mT
    skew = (difference - difference.mT) / 2
    axis = torch.stack((skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]), dim=-1)
    return _angle(axis, (difference.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2)


def rotation_deg(estimate: Float[Tensor, "*B 3 3"], truth: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B"]:
    """Angle of the rotation between the two, degrees in [0, 180]."""
    return torch.rad2deg(_rotation_angle(estimate, truth))


def quaternion_error(
    estimate: Float[Tensor, "*B 3 3"], truth: Float[Tensor, "*B 3 3"]
) -> Float[Tensor, "*B"]:
    """E_R = |quat(R) - quat(R*)|, with the signs of the quaternions chosen so that they are nearest.

    That equals the difference of the quaternions with w >= 0, except where both turn by almost 180 degrees:
    there the two signs may differ, and a tiny error would count as 2. With a the angle between R and R*, it
    is 2 sin(a / 4).
    """
    return 2 * torch.sin(_rotation_angle(estimate, truth) / 4)


def translation_error(estimate: Float[Tensor, "*B 3"], truth: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B"]:
    """E_t = |t - t*|, mm."""
    return torch.linalg.vector_norm(estimate.double() - truth.double(), dim=-1)


def translation_deg(estimate: Float[Tensor, "*B 3"], truth: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B"]:
    """Angle between the directions of the two, degrees in [0, 180]: what is known when the scale is not."""
    estimate, truth = estimate.double(), truth.double()
    return torch.rad2deg(_angle(torch.linalg.cross(estimate, truth), (estimate * truth).sum(-1)))


def error_2d(estimate: Cameras, truth: Cameras, points: Float[Tensor, "*B N 3"]) -> Float[Tensor, "*B"]:
    """E_2D, pixels: mean distance of the points X* as the estimated and as the true target camera see them.

    ``estimate`` and ``truth`` are pairs (V = 2): the reference camera, then the target camera.
    """
    difference = project(estimate, points)[0][..., 1, :, :] - project(truth, points)[0][..., 1, :, :]
    return torch.linalg.vector_norm(difference, dim=-1).mean(-1)


class MeanError(Metric):
    """The mean of one of this module's errors over all that was added: a float64 sum and an exact count."""

    full_state_update = False
    error_sum: Tensor
    count: Tensor

    def __init__(self, error: Callable[..., Tensor]) -> None:
        super().__init__()
        self.error = error
        self.add_state("error_sum", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("count", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, *arguments: Tensor | Cameras) -> None:
        """Add the errors of ``error(*arguments)``."""
        errors = self.error(*arguments)
        self.error_sum += errors.double().sum()
        self.count += errors.numel()

    def compute(self) -> Float[Tensor, ""]:
        """NaN when nothing was added."""
        return self.error_sum / self.count
