"""How well a calibration explains a recording, and how far two calibrations of one rig are apart."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.geometry.cameras import Cameras, reprojection_error
from ghpt.geometry.rotations import nearest_rotation
from ghpt.metrics.relative_pose import rotation_deg
from ghpt.models.estimators.classical import Estimator
from ghpt.observations import Observations, Recording
from ghpt.skeleton import BONES, JOINT, PELVIS, THORAX

_FRAMES = 256
"""Frames that are triangulated at once."""


@dataclass(frozen=True)
class Similarity:
    """From one world to another: ``X' = scale R X + t``; mm."""

    R: Float[Tensor, "3 3"]
    scale: float
    t: Float[Tensor, " 3"]

    def points(self, points: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
        return self.scale * (points @ self.R.mT) + self.t

    def cameras(self, cameras: Cameras) -> Cameras:
        """The same cameras in the other world: what they see stays where it is in their images."""
        R = cameras.R @ self.R.mT
        return Cameras(cameras.K, R, self.scale * cameras.t - (R @ self.t[:, None])[..., 0])

    def covariance(self, covariance: Float[Tensor, "V 6 6"]) -> Float[Tensor, "V 6 6"]:
        """Of turns (radians, about the world's axes) and centres (mm)."""
        change = torch.block_diag(self.R, self.scale * self.R)
        return change @ covariance @ change.T


def align(cameras: Cameras, reference: Cameras, rigid: bool = False) -> Similarity:
    """The similarity (with scale 1 if ``rigid``) that brings a rig onto a reference rig with the
    same V >= 2 cameras.

    Its rotation is the mean (chordal) of the cameras' own; scale and translation then fit the
    centres in least squares. Scale 1 where the centres of either rig coincide.
    """
    R = nearest_rotation((reference.R.mT @ cameras.R).sum(0))
    source = cameras.centre @ R.mT
    target = reference.centre
    a = source - source.mean(0)
    b = target - target.mean(0)
    variance = float((a * a).sum())
    product = float((a * b).sum())
    scale = product / variance if variance > 0 and product > 0 and not rigid else 1.0
    return Similarity(R, scale, target.mean(0) - scale * source.mean(0))


@dataclass(frozen=True)
class RigDifference:
    """Of an estimated rig from a reference rig, after ``align``."""

    rotation_deg: Float[Tensor, " V"]
    centre_mm: Float[Tensor, " V"]
    """Between the centres, in the reference's millimetres."""
    scale: float
    """Size of the reference over the estimate's: 1 where both have the same millimetre."""


def rig_difference(cameras: Cameras, reference: Cameras) -> RigDifference:
    """What ``align`` leaves between two calibrations of one rig."""
    gauge = align(cameras, reference)
    moved = gauge.cameras(cameras)
    centre = torch.linalg.vector_norm(moved.centre - reference.centre, dim=-1)
    return RigDifference(rotation_deg(moved.R, reference.R), centre, gauge.scale)


def triangulate_recording(
    recording: Recording, estimator: Estimator, without: int | None = None
) -> tuple[Float[Tensor, "T J 3"], Bool[Tensor, "T J"]]:
    """The recording's joints (world, mm) by ``estimator``, and which are estimated; ``without``
    leaves out a view.
    """
    points = []
    estimated = []
    for first in range(0, len(recording), _FRAMES):
        rows = slice(first, first + _FRAMES)
        valid = torch.from_numpy(recording.valid[rows].copy())
        if without is not None:
            valid[:, without] = False
        count = len(valid)
        rig = recording.cameras
        batch = Observations(
            index=torch.arange(first, first + count),
            recording=torch.zeros(count, dtype=torch.int64),
            cameras=Cameras(*(x.expand(count, *x.shape) for x in (rig.K, rig.R, rig.t))),
            key_points=torch.from_numpy(recording.key_points[rows]).double(),
            confidence=torch.from_numpy(recording.confidence[rows]).double(),
            valid=valid,
        )
        result = estimator(batch)
        points.append(result.points)
        estimated.append(result.estimated)
    return torch.cat(points), torch.cat(estimated)


def held_out_errors(
    recording: Recording, estimator: Estimator
) -> tuple[Float[Tensor, "T V J"], Bool[Tensor, "T V J"]]:
    """For each view the distance (pixels) of its key points from the joints that the *other* views
    give, and where there is one: seen in the view, estimated without it, and in front of it.
    """
    errors = []
    measured = []
    key_points = torch.from_numpy(recording.key_points).double()
    for view in range(len(recording.camera_names)):
        points, estimated = triangulate_recording(recording, estimator, without=view)
        one = recording.cameras.index(slice(view, view + 1))
        error = reprojection_error(one, key_points[:, view : view + 1], points)[:, 0]
        counted = estimated & torch.from_numpy(recording.valid[:, view]) & torch.isfinite(error)
        errors.append(torch.where(counted, error, 0.0))
        measured.append(counted)
    return torch.stack(errors, dim=1), torch.stack(measured, dim=1)


def segment_variation(
    points: Float[Tensor, "T J 3"], estimated: Bool[Tensor, "T J"]
) -> tuple[Float[Tensor, " L"], Bool[Tensor, " L"]]:
    """How much each body part's length varies over the frames, 1.4826 x median deviation over the
    median, and which parts were seen in two frames or more.
    """
    a, b = torch.tensor(BONES).unbind(1)
    both = estimated[:, a] & estimated[:, b]
    length = torch.where(both, (points[:, a] - points[:, b]).norm(dim=-1), torch.nan)
    median = length.nanmedian(0).values
    spread = 1.4826 * (length - median).abs().nanmedian(0).values
    known = (both.sum(0) >= 2) & (median > 0)
    return torch.where(known, spread / torch.where(known, median, 1.0), 0.0), known


def upright(
    points: Float[Tensor, "T J 3"], estimated: Bool[Tensor, "T J"], cameras: Cameras
) -> Similarity:
    """To a world with z along the people's mean direction from hips to neck, the floor at their
    lowest ankles, the origin below where they mostly are, and x where the first camera looks. Only
    as true as they stood upright.
    """
    trunk = (points[:, THORAX] - points[:, PELVIS])[estimated[:, THORAX] & estimated[:, PELVIS]]
    trunk = torch.nn.functional.normalize(trunk, dim=-1).sum(0)
    z = trunk if float(trunk.norm()) > 0 else -cameras.R[0, 1]
    z = z / z.norm()
    x = cameras.R[0, 2] - (cameras.R[0, 2] @ z) * z
    x = (
        x if float(x.norm()) > 1e-3 else cameras.R[0, 0] - (cameras.R[0, 0] @ z) * z
    )  # it looks straight down
    x = x / x.norm()
    R = torch.stack((x, torch.linalg.cross(z, x), z))
    there = points[estimated] @ R.mT
    ankles = points[:, ANKLES][estimated[:, ANKLES]] @ R.mT
    if not len(there):
        return Similarity(R, 1.0, torch.zeros(3, dtype=R.dtype))
    middle = there.median(0).values
    floor = (ankles if len(ankles) else there)[:, 2].quantile(0.05)
    return Similarity(R, 1.0, -torch.stack((middle[0], middle[1], floor)))


ANKLES = [JOINT["left_ankle"], JOINT["right_ankle"]]
