"""One person before a rig, whose key points are read as they are asked for."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence as Items
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ghpt.data.formats.skeletons import map_to_joints
from ghpt.data.points import KeyPoints
from ghpt.geometry.cameras import Cameras, CameraSet
from ghpt.geometry.normal_equations import local_cameras
from ghpt.observations import Observations
from ghpt.reconstruction import Reconstruction
from ghpt.skeleton import HUMAN36M, Skeleton

_NEAR = 1e5
"""Distance (mm, along an axis) from the world's zero up to which a rig stays where it is.

float32, in which hypotheses are scored and estimators compared, has steps of 0.008 mm there;
farther away they pass 0.01 mm, and reach half a metre in national grids (5,000 km). Nearer rigs are
left alone because their scores would change in the last digit, for nothing."""
_WHOLE = 1000.0
"""The origin of a rig farther away has whole metres, so that people can read it and add it."""
_CHUNK = 4096
"""Frames that are read at a time for the digest."""

Rows = Int[np.ndarray, " N"]
"""Positions of frames in a sequence, rising."""


@runtime_checkable
class KeyPointSource(Protocol):
    """Where a sequence's key points [N V J] of some of its frames are."""

    def undistorted(self, rows: Rows) -> KeyPoints:
        """Return what ideal pinhole cameras would see; float32."""

    def detected(self, rows: Rows) -> KeyPoints:
        """Return the pixels of the images as they were, lens distortion and all."""


@dataclass(frozen=True)
class KeyPointArrays:
    """Key points of all frames in memory, or in memory maps."""

    points: KeyPoints
    """Undistorted, [T V J]."""
    raw: KeyPoints
    """As detected, [T V J]."""

    def undistorted(self, rows: Rows) -> KeyPoints:
        return self.points[rows]

    def detected(self, rows: Rows) -> KeyPoints:
        return self.raw[rows]


@dataclass(frozen=True)
class SelectedKeyPoints:
    """Some of the key points of a source."""

    points: KeyPointSource
    chosen: tuple[int, ...]

    def undistorted(self, rows: Rows) -> KeyPoints:
        return self.points.undistorted(rows).select(self.chosen)

    def detected(self, rows: Rows) -> KeyPoints:
        return self.points.detected(rows).select(self.chosen)


@dataclass(frozen=True)
class MappedKeyPoints:
    """The 17 joints, of a source of key points with another skeleton."""

    points: KeyPointSource
    skeleton: Skeleton

    def undistorted(self, rows: Rows) -> KeyPoints:
        return map_to_joints(self.points.undistorted(rows), self.skeleton)

    def detected(self, rows: Rows) -> KeyPoints:
        return map_to_joints(self.points.detected(rows), self.skeleton)


@dataclass(frozen=True)
class Sequence:
    """T frames of one person before V cameras, in any calibration state."""

    title: str
    source: str
    """``synthetic`` or the path of the key points."""
    cameras: CameraSet
    """Of the views, in their order, in mm, with the lenses that the detected key points show."""
    frame: Int[np.ndarray, " T"]
    """The recording's own numbers, rising."""
    rate_hz: float | None
    points: KeyPointSource
    skeleton: Skeleton = HUMAN36M
    """Of the key points: their J axis has its order."""

    def __len__(self) -> int:
        return len(self.frame)

    def as_joints(self) -> Sequence:
        """Return the sequence of the 17 joints, which are means of the key points in the images.

        A joint that the skeleton does not give is never valid.
        """
        if self.skeleton == HUMAN36M:
            return self
        mapped = MappedKeyPoints(self.points, self.skeleton)
        return replace(self, points=mapped, skeleton=HUMAN36M)

    def select_key_points(self, chosen: Items[int]) -> Sequence:
        """Return the sequence of some of the key points, in this order."""
        if list(chosen) == list(range(len(self.skeleton))):
            return self
        selected = SelectedKeyPoints(self.points, tuple(chosen))
        return replace(self, points=selected, skeleton=self.skeleton.select(chosen))

    def undistorted(self, rows: Rows | None = None) -> KeyPoints:
        """Return the undistorted key points of some frames, or of all."""
        return self.points.undistorted(self._rows(rows))

    def detected(self, rows: Rows | None = None) -> KeyPoints:
        """Return the key points of some frames, or of all, as the detector gave them."""
        return self.points.detected(self._rows(rows))

    def select_views(self, views: Items[int]) -> Sequence:
        """Return the sequence of some of the views, in this order, in memory."""
        at = list(views)
        arrays = KeyPointArrays(self.undistorted()[:, at], self.detected()[:, at])
        return replace(self, cameras=self.cameras.select(at), points=arrays)

    def spread(self, most: int) -> Rows:
        """Return at most so many rows, evenly spread."""
        count = min(most, len(self))
        return np.unique(np.linspace(0, len(self) - 1, count).astype(np.int64))

    @cached_property
    def origin(self) -> Float[Tensor, " 3"]:
        """The zero of the observations' world, mm in the cameras' world, float64.

        It is (0, 0, 0), or near the rig's centre if that is far away.
        """
        _, centre = local_cameras(self.cameras.cameras)
        if float(centre.abs().max()) <= _NEAR:
            return torch.zeros_like(centre)
        return (centre / _WHOLE).round() * _WHOLE + 0.0  # no -0

    def read(self, rows: Rows) -> Observations:
        """Return the observations of some frames, before cameras whose world has its zero at
        ``origin``.

        A frame's ``index`` is its own number, so its random draws are the same in any batch.
        """
        points = self.undistorted(rows)
        count = len(rows)
        return Observations(
            index=torch.from_numpy(self.frame[rows]),
            recording=torch.zeros(count, dtype=torch.int64),
            cameras=self._local_cameras.expand(count),
            key_points=torch.from_numpy(points.pixels),
            confidence=torch.from_numpy(points.confidence),
            valid=torch.from_numpy(points.valid),
        )

    def to_world(self, part: Reconstruction) -> Reconstruction:
        """Return what was reconstructed of observations in the cameras' own world."""
        return replace(part, points=part.points.double() + self.origin)

    def digest(self) -> str:
        """Return a SHA-256 of all that is known: cameras, frame numbers and key points."""
        skeleton = (self.skeleton.key_points, self.skeleton.pairs, self.skeleton.joints)
        about = (self.cameras.names, len(self), self.rate_hz, skeleton)
        digest = hashlib.sha256(repr(about).encode())
        cameras = self.cameras.cameras
        for tensor in (cameras.K, cameras.R, cameras.t):
            digest.update(tensor.double().contiguous().numpy().tobytes())
        digest.update(self.frame.astype(np.int64).tobytes())
        for start in range(0, len(self), _CHUNK):
            rows = np.arange(start, min(start + _CHUNK, len(self)))
            points = self.undistorted(rows)
            for array in (points.pixels, points.confidence, points.valid):
                digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    @cached_property
    def _local_cameras(self) -> Cameras:
        return self.cameras.cameras.relative_to(self.origin)

    def _rows(self, rows: Rows | None) -> Rows:
        return np.arange(len(self)) if rows is None else rows
