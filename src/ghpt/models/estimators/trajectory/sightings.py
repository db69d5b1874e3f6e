"""What the views see of single frames, for an estimate of one frame after the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from ghpt.geometry.cameras import Cameras
from ghpt.geometry.normal_equations import valid_cameras
from ghpt.geometry.triangulation import flat_cameras
from ghpt.models.estimators.predictors import remove_outliers
from ghpt.observations import Observations

Array = np.ndarray

_ONE_CENTRE = 1e-12
"""Centres closer than this fraction of the largest coordinate are one centre."""
_FEW = 6
"""Joints in a view; the box around fewer is not the person's."""


@dataclass(frozen=True)
class Frame:
    """What the views see of a frame."""

    number: int
    is_given: bool
    """False for one that the recording leaves out."""
    cameras: Cameras
    key_points: Float[Array, "V J 2"]
    confidence: Float[Array, "V J"]
    used: Bool[Array, "V J"]
    rejected: Bool[Array, "V J"]
    """The key points that no detection can be."""

    @property
    def extent(self) -> Float[Array, " V"]:
        """The diagonal of the box around the key points of each view, pixels; NaN for a few."""
        used = self.used[..., None]
        largest = np.where(used, self.key_points, -np.inf).max(1)
        smallest = np.where(used, self.key_points, np.inf).min(1)
        many = self.used.sum(1)[:, None] >= _FEW
        return np.linalg.norm(np.where(many, largest - smallest, np.nan), axis=-1)


@dataclass(frozen=True)
class Rig:
    """The cameras of a frame in a local world, whose lengths are those of an adult.

    A body of another size is in a world so many times as large.
    """

    projection: Float[Array, "V 3 4"]
    """Pixels x depth, and depth, of a point (x, y, z, 1)."""
    focal: Float[Array, " V"]
    apart: Bool[Array, "V V"]
    """The pairs of views that have two centres."""

    @staticmethod
    def of(cameras: Cameras, origin: torch.Tensor, size: float) -> Rig:
        valid = valid_cameras(cameras)[:, None]
        one = torch.eye(3, dtype=torch.float64)
        K = torch.where(valid[..., None], cameras.K.double(), one)
        R = torch.where(valid[..., None], cameras.R.double(), one)
        t = torch.where(valid, cameras.t.double() + R @ origin, 0.0) / size
        centre = -(R.mT @ t[..., None])[..., 0]
        largest = centre.abs().max().clamp(min=1e-300)
        return Rig(
            projection=(K @ torch.cat((R, t[..., None]), -1)).numpy(),
            focal=(K[:, 0, 0] * K[:, 1, 1]).sqrt().numpy(),
            apart=(torch.cdist(centre, centre) > _ONE_CENTRE * largest).numpy(),
        )

    def rows(self, key_points: Float[Array, "V J 2"]) -> Float[Array, "V J 2 4"]:
        """Return the equations of key points: residuals at the body's depth, mm."""
        depth = self.projection[:, None, None, 2]
        rows = key_points[..., None] * depth - self.projection[:, None, :2]
        return rows / self.focal[:, None, None, None]

    def depth(self, points: Float[Array, "*P J 3"]) -> Float[Array, "*P V J"]:
        """Return the depth of points in each view, mm."""
        axis = self.projection[:, 2]
        return axis[:, :3] @ np.swapaxes(points, -1, -2) + axis[:, 3:]

    def fixed(self, views: Bool[Array, "V J"]) -> Bool[Array, " J"]:
        """Return the joints that these views see from two places."""
        pairs = self.apart.astype(float) @ views
        return (pairs * views).any(0)


@dataclass(frozen=True)
class Stack:
    """The key points of K frames."""

    rows: Float[Array, "4 2 K V J"]
    """Residuals at the body's depth, mm, of a point (x, y, z, 1)."""
    gram: Float[Array, "K V J 4 4"]
    """Products of the two rows of each key point."""
    used: Bool[Array, "K V J"]
    confidence: Float[Array, "K V J"]

    @staticmethod
    def of(frame: Frame, rig: Rig) -> Stack:
        rows = rig.rows(frame.key_points)
        gram = np.swapaxes(rows, -1, -2) @ rows
        rows = np.ascontiguousarray(rows.transpose(3, 2, 0, 1))[:, :, None]
        return Stack(rows, gram[None], frame.used[None], frame.confidence[None])

    def join(self, other: Stack) -> Stack:
        """Return the frames of both."""
        return Stack(
            np.concatenate((self.rows, other.rows), axis=2),
            np.concatenate((self.gram, other.gram)),
            np.concatenate((self.used, other.used)),
            np.concatenate((self.confidence, other.confidence)),
        )

    def without_oldest(self) -> Stack:
        return Stack(self.rows[:, :, 1:], self.gram[1:], self.used[1:], self.confidence[1:])

    def exchange(self, order: Int[Array, "K V J"]) -> Stack:
        """Return the same with each joint having the key point of another one of its view."""
        return Stack(
            np.take_along_axis(self.rows, order[None, None], 4),
            np.take_along_axis(self.gram, order[..., None, None], 2),
            np.take_along_axis(self.used, order, 2),
            np.take_along_axis(self.confidence, order, 2),
        )

    def residuals(self, points: Float[Array, "K J 3"]) -> Float[Array, "K V J"]:
        """Return the lengths of the residuals, mm."""
        return residual_lengths(self.rows, points)


def residual_lengths(
    rows: Float[Array, "4 2 *P V J"], points: Float[Array, "*P J 3"]
) -> Float[Array, "*P V J"]:
    """Return the lengths of the residuals of points, mm."""
    x = points[..., None, :, 0]
    y = points[..., None, :, 1]
    z = points[..., None, :, 2]
    over, down = rows[0] * x + rows[1] * y + rows[2] * z + rows[3]
    length: Array = np.sqrt(over * over + down * down)
    return length


def frames_of(batch: Observations) -> list[Frame]:
    """Return the frames of a batch, without what no detection can be."""
    clean, rejected = remove_outliers(batch)
    rig = flat_cameras(clean.cameras, clean.valid.shape[:1])
    shared = rig.index(0)
    key_points = clean.key_points.double().numpy()
    confidence = clean.confidence.double().numpy()
    frames = []
    for row, number in enumerate(clean.index.tolist()):
        frame = Frame(
            number=number,
            is_given=True,
            cameras=shared if len(rig.t) == 1 else rig.index(row),
            key_points=key_points[row],
            confidence=confidence[row],
            used=clean.valid[row].numpy(),
            rejected=rejected[row].numpy(),
        )
        frames.append(frame)
    return frames


def blank(frame: Frame, number: int) -> Frame:
    """Return a frame in which nothing is seen."""
    nothing = np.zeros_like(frame.used)
    return replace(frame, number=number, is_given=False, used=nothing, rejected=nothing)


def as_observations(frames: Sequence[Frame]) -> Observations:
    """Return frames as a batch."""
    cameras = [frame.cameras for frame in frames]
    return Observations(
        index=torch.tensor([frame.number for frame in frames]),
        recording=torch.zeros(len(frames), dtype=torch.int64),
        cameras=Cameras(
            torch.stack([camera.K for camera in cameras]),
            torch.stack([camera.R for camera in cameras]),
            torch.stack([camera.t for camera in cameras]),
        ),
        key_points=torch.from_numpy(np.stack([frame.key_points for frame in frames])).float(),
        confidence=torch.from_numpy(np.stack([frame.confidence for frame in frames])).float(),
        valid=torch.from_numpy(np.stack([frame.used for frame in frames])),
    )
