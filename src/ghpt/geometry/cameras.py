"""Ideal pinhole cameras: ``x_cam = R X + t``, ``lambda (u, v, 1) = K x_cam``; OpenCV axes, mm and
pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Cameras:
    """V cameras, with any leading dimensions: the views of a rig, or of each frame of a batch."""

    K: Float[Tensor, "*B V 3 3"]
    """Intrinsics, pixels; the centre of the first pixel is (0, 0)."""
    R: Float[Tensor, "*B V 3 3"]
    """World to camera rotation."""
    t: Float[Tensor, "*B V 3"]
    """World to camera translation, mm; not the centre."""

    @property
    def centre(self) -> Float[Tensor, "*B V 3"]:
        """Camera centres in the world, ``-R^T t``."""
        return -(self.R.mT @ self.t[..., None])[..., 0]

    def relative_to(self, origin: Float[Tensor, " 3"]) -> Cameras:
        """The same cameras in a world whose zero is ``origin`` (mm) of theirs; float64."""
        double = self.to(torch.float64)
        shift = double.R @ origin.to(double.R)[:, None]
        return Cameras(double.K, double.R, double.t + shift[..., 0])

    def index(self, item: Any) -> Cameras:
        """Index the leading dimensions."""
        return Cameras(self.K[item], self.R[item], self.t[item])

    def to(self, *args: Any, **kwargs: Any) -> Cameras:
        return Cameras(*(x.to(*args, **kwargs) for x in (self.K, self.R, self.t)))

    def pin_memory(self) -> Cameras:
        return Cameras(*(x.pin_memory() for x in (self.K, self.R, self.t)))


def project(
    cameras: Cameras, points: Float[Tensor, "*B J 3"]
) -> tuple[Float[Tensor, "*B V J 2"], Float[Tensor, "*B V J"]]:
    """Return pixels and depths (mm) of world points in every view.

    Behind a camera (depth <= 0) pixels mean nothing, and are finite except at depth 0 exactly,
    where they are 0.
    """
    in_camera = points[..., None, :, :] @ cameras.R.mT + cameras.t[..., None, :]
    depth = in_camera[..., 2]
    homogeneous = in_camera @ cameras.K.mT
    at_centre = depth == 0
    safe_depth = torch.where(at_centre, 1.0, depth)
    pixels = homogeneous[..., :2] / safe_depth[..., None]
    return torch.where(at_centre[..., None], 0.0, pixels), depth


def reprojection_error(
    cameras: Cameras,
    key_points: Float[Tensor, "*B V J 2"],
    points: Float[Tensor, "*B J 3"],
) -> Float[Tensor, "*B V J"]:
    """Return the distance in pixels between key points and the projected points, float64.

    It is inf behind a camera and where an input is not finite.
    """
    double = cameras.to(torch.float64)
    pixels, depth = project(double, points.double())
    error = torch.linalg.vector_norm(pixels - key_points, dim=-1)
    measurable = (depth > 0) & torch.isfinite(error)
    return torch.where(measurable, error, torch.inf)
