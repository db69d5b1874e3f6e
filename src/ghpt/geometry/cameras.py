"""Ideal pinhole cameras: ``x_cam = R X + t``, ``lambda (u, v, 1) = K x_cam``; OpenCV axes, mm and
pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ghpt.clock import Clock
from ghpt.errors import GhptDataError


def camera_centre(R: Float[Tensor, "*B 3 3"], t: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
    """Return the centre of each world-to-camera pose, ``-R^T t``, in the world."""
    return -(R.mT @ t[..., None])[..., 0]


def relative_pose(
    R_a: Float[Tensor, "*A 3 3"],
    t_a: Float[Tensor, "*A 3"],
    R_b: Float[Tensor, "*B 3 3"],
    t_b: Float[Tensor, "*B 3"],
) -> tuple[Float[Tensor, "*B 3 3"], Float[Tensor, "*B 3"]]:
    """Return R and t of ``x_b = R x_a + t``, from the frame of camera a to that of camera b."""
    R = R_b @ R_a.mT
    return R, t_b - (R @ t_a[..., None])[..., 0]


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
        """The camera centres in the world, mm."""
        return camera_centre(self.R, self.t)

    def relative_pose(
        self,
        reference: int,
        target: int | slice,
    ) -> tuple[Float[Tensor, "*B 3 3"], Float[Tensor, "*B 3"]]:
        """Return R and t of ``x_target = R x_reference + t``.

        A slice of targets, of a rig without leading dimensions, gives the poses of all of them.
        """
        R_a = self.R[..., reference, :, :]
        t_a = self.t[..., reference, :]
        return relative_pose(R_a, t_a, self.R[..., target, :, :], self.t[..., target, :])

    def relative_to(self, origin: Float[Tensor, " 3"]) -> Cameras:
        """Return the same cameras in a world whose zero is ``origin`` (mm) of theirs; float64."""
        double = self.to(torch.float64)
        offset = double.R @ origin.to(double.R)[:, None]
        return Cameras(double.K, double.R, double.t + offset[..., 0])

    def expand(self, count: int) -> Cameras:
        """Return the cameras ``count`` times along a new leading dimension; no memory is copied."""
        K = self.K.expand(count, *self.K.shape)
        R = self.R.expand(count, *self.R.shape)
        t = self.t.expand(count, *self.t.shape)
        return Cameras(K, R, t)

    def index(self, item: Any) -> Cameras:
        """Index the leading dimensions."""
        return Cameras(self.K[item], self.R[item], self.t[item])

    def to(self, *args: Any, **kwargs: Any) -> Cameras:
        """Return the cameras on another device or in another dtype, as ``Tensor.to`` takes them."""
        K = self.K.to(*args, **kwargs)
        R = self.R.to(*args, **kwargs)
        t = self.t.to(*args, **kwargs)
        return Cameras(K, R, t)

    def pin_memory(self) -> Cameras:
        """Return the cameras in page-locked memory."""
        return Cameras(self.K.pin_memory(), self.R.pin_memory(), self.t.pin_memory())


@dataclass(frozen=True)
class CameraSet:
    """V named cameras with their lenses, as a file or a data set has them.

    The intrinsics are always known; the extrinsics (mm) and the image sizes only where the file
    has them for all cameras.
    """

    names: tuple[str, ...]
    K: Float[Tensor, "V 3 3"]
    """Intrinsics, pixels, float64."""
    distortion: Float[Tensor, "V C"]
    """Coefficients of ``ghpt.geometry.lens``: k1, k2, p1, p2, k3, or nine numbers where a lens of
    the rig needs more.
    """
    size: Int[Tensor, "V 2"] | None = None
    """Width and height of the images, pixels."""
    R: Float[Tensor, "V 3 3"] | None = None
    """World to camera; None, with ``t``, for cameras without extrinsics."""
    t: Float[Tensor, "V 3"] | None = None
    unposed: tuple[str, ...] = ()
    """The cameras that have no extrinsics; where two others have them, R and t are NaN for these.
    """
    other_names: tuple[str, ...] = ()
    """What else the file calls each camera (a TOML table's key), '' where nothing; may be empty."""
    path: str = ""
    """The file, or what else errors are to name."""
    format: str = "ghpt"
    unit_known: bool = True
    """False where the file has no unit of length and nobody gave one: ``t`` is in mm by a guess."""
    unit_mm: float = 1.0
    """Length of the file's own unit, given, the format's or guessed."""
    clock: Clock | None = None
    """When the cameras' frames are taken, where the file says it."""

    @classmethod
    def from_cameras(
        cls,
        names: Sequence[str],
        cameras: Cameras,
        distortion: Float[Tensor, "V C"] | None = None,
        size: Int[Tensor, "V 2"] | None = None,
        path: str = "",
    ) -> CameraSet:
        """Return calibrated cameras under these names; no ``distortion`` means ideal pinholes."""
        if distortion is None:
            distortion = cameras.K.new_zeros(len(names), 5)
        return cls(
            names=tuple(names),
            K=cameras.K,
            distortion=distortion,
            size=size,
            R=cameras.R,
            t=cameras.t,
            path=path,
        )

    def __len__(self) -> int:
        return len(self.names)

    @property
    def calibrated(self) -> bool:
        """Whether all cameras have extrinsics."""
        return self.R is not None and self.t is not None and not self.unposed

    @property
    def cameras(self) -> Cameras:
        """The calibrated cameras. Raises GhptDataError where not all have extrinsics."""
        if self.R is None or self.t is None or self.unposed:
            raise self._uncalibrated_error()
        return Cameras(self.K, self.R, self.t)

    def is_posed(self, camera: int) -> bool:
        """Return whether this camera has extrinsics."""
        return self.R is not None and self.names[camera] not in self.unposed

    def without_extrinsics(self) -> CameraSet:
        """Return the same cameras with intrinsics alone."""
        return replace(self, R=None, t=None)

    def _uncalibrated_error(self) -> GhptDataError:
        problem = f"are not there for {', '.join(self.unposed or self.names)}"
        return GhptDataError(self.path, "rotation, translation", problem, _CALIBRATE)

    def check_calibrated(self, where: str) -> None:
        """Raise GhptDataError unless two cameras or more have extrinsics.

        ``where`` is what the views are of: a file of cameras or of key points.
        """
        if len(self) < 2:
            problem = f"there is only {', '.join(self.names) or 'none'}"
            hint = "A place in space takes two views or more of the same moment."
            raise GhptDataError(where, "views", problem, hint)
        if self.R is None:
            raise self._uncalibrated_error()

    @property
    def image_size(self) -> Int[Tensor, "V 2"]:
        """Width and height, pixels; twice the principal point where ``size`` is not known."""
        if self.size is not None:
            return self.size
        return (2 * self.K[:, :2, 2] + 1).round().long()

    def select(self, indices: Sequence[int]) -> CameraSet:
        """Return some of the cameras, in this order."""
        at = list(indices)
        return replace(
            self,
            names=tuple(self.names[i] for i in at),
            other_names=tuple(self.other_names[i] for i in at) if self.other_names else (),
            K=self.K[at],
            distortion=self.distortion[at],
            size=None if self.size is None else self.size[at],
            R=None if self.R is None else self.R[at],
            t=None if self.t is None else self.t[at],
            unposed=tuple(self.names[i] for i in at if self.names[i] in self.unposed),
            clock=None if self.clock is None else self.clock.select(at),
        )

    def with_cameras(self, cameras: Cameras) -> CameraSet:
        """Return the same lenses and images with other pinhole cameras, in mm."""
        return replace(self, K=cameras.K, R=cameras.R, t=cameras.t, unposed=())

    def without_distortion(self) -> CameraSet:
        """Return the cameras as the ideal pinholes that undistorted key points are of."""
        return replace(self, distortion=torch.zeros_like(self.distortion))


_CALIBRATE = (
    "Calibrate first (python calibrate.py keypoints=... cameras=...), "
    "and give the rig.toml that it writes."
)


def project(
    cameras: Cameras,
    points: Float[Tensor, "*B J 3"],
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
