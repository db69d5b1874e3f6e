"""The frames of a recording, read as they are asked for, with all that predicting them takes."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.calibration.check.units import decide_unit
from ghpt.commands.prediction.shards import Shards
from ghpt.data.people.views import Views
from ghpt.errors import GhptDataError
from ghpt.export import Evidence
from ghpt.geometry.cameras import Cameras, CameraSet
from ghpt.geometry.normal_equations import local_cameras
from ghpt.models.estimators.classical import Baseline
from ghpt.observations import Observations
from ghpt.reconstruction import Reconstruction

_NEAR = 1e5
"""Distance (mm, along an axis) from the world's zero up to which a rig stays where it is.

float32, in which hypotheses are scored and estimators compared, has steps of 0.008 mm there;
farther away they pass 0.01 mm, and reach half a metre in national grids (5,000 km). Nearer rigs are
left alone because their scores would change in the last digit, for nothing."""
_WHOLE = 1000.0
"""The origin of a rig farther away has whole metres, so that people can read it and add it."""
MEASURED = 64
"""Frames by which the person tells the unit of length."""
_STAMPED = 4096
"""Frames that are read at a time for the stamp."""

Seen = tuple[Float[np.ndarray, "N V J 2"], Float[np.ndarray, "N V J"], Bool[np.ndarray, "N V J"]]
"""Undistorted pixels (float32), confidences and what is seen, of the 17 joints."""


@dataclass(frozen=True)
class Detected:
    """The recording as the detector and the camera file have it."""

    cameras: CameraSet
    """Of the views, in their order, in mm."""
    read: Callable[[Int[np.ndarray, " N"]], Seen]
    """Pixels through the lens, confidences and what is seen, of some rows, which rise."""


@dataclass(frozen=True)
class Frames:
    """T frames of one person before V calibrated cameras."""

    title: str
    source: str
    """``synthetic`` or the path of the key points."""
    camera_names: tuple[str, ...]
    cameras: Cameras
    """Leading dimension V, mm, float64."""
    frame: Int[np.ndarray, " T"]
    """The recording's own numbers, rising."""
    rate_hz: float | None
    read: Callable[[Int[np.ndarray, " N"]], Seen]
    """The key points of some rows, which rise."""
    detected: Detected | None = None
    """The same through the lenses, as the camera check needs them; None for recordings without."""

    def __len__(self) -> int:
        return len(self.frame)

    @cached_property
    def origin(self) -> Float[Tensor, " 3"]:
        """The zero of the batches' world, mm in the cameras' world, float64: (0, 0, 0), or near the
        rig's centre if that is far away."""
        _, centre = local_cameras(self.cameras)
        if float(centre.abs().max()) <= _NEAR:
            return torch.zeros_like(centre)
        return (centre / _WHOLE).round() * _WHOLE + 0.0  # no -0

    def to_world(self, part: Reconstruction) -> Reconstruction:
        """What was reconstructed of a batch, in the cameras' world."""
        return replace(part, points=part.points.double() + self.origin)

    def batch(self, rows: Int[np.ndarray, " N"]) -> Observations:
        """Some rows, before cameras in a world whose zero is ``origin``.

        A frame's ``index`` is its own number, so its random draws are the same in any batch.
        """
        key_points, confidence, valid = (torch.from_numpy(values) for values in self.read(rows))
        count = len(rows)
        rig = self.cameras.relative_to(self.origin)
        return Observations(
            index=torch.from_numpy(self.frame[rows]),
            recording=torch.zeros(count, dtype=torch.int64),
            cameras=Cameras(*(x.expand(count, *x.shape) for x in (rig.K, rig.R, rig.t))),
            key_points=key_points,
            confidence=confidence,
            valid=valid,
        )

    def spread(self, most: int) -> Int[np.ndarray, " N"]:
        """At most so many rows, evenly spread."""
        return np.unique(np.linspace(0, len(self) - 1, min(most, len(self))).astype(np.int64))

    def stamp(self) -> str:
        """SHA-256 of all that is known of the recording: cameras, numbers and key points."""
        digest = hashlib.sha256(repr((self.camera_names, len(self), self.rate_hz)).encode())
        for value in (self.cameras.K, self.cameras.R, self.cameras.t):
            digest.update(value.double().contiguous().numpy().tobytes())
        digest.update(self.frame.astype(np.int64).tobytes())
        for start in range(0, len(self), _STAMPED):
            for values in self.read(np.arange(start, min(start + _STAMPED, len(self)))):
                digest.update(np.ascontiguousarray(values).tobytes())
        return digest.hexdigest()


def frames_of_views(views: Views, source: str, title: str) -> Frames:
    """Of key points in memory. Raises GhptDataError for less than two views, and for cameras
    without extrinsics.
    """

    def read(rows: Int[np.ndarray, " N"]) -> Seen:
        return views.key_points[rows], views.confidence[rows], views.valid[rows]

    rate = None if views.rate_hz is None or math.isnan(views.rate_hz) else float(views.rate_hz)
    cameras = views.cameras
    rig = calibrated(source, cameras)
    detected = Detected(replace(cameras, distortion=torch.zeros_like(cameras.distortion)), read)
    return Frames(
        title, source, cameras.names, rig, views.frame.astype(np.int64), rate, read, detected
    )


def in_unit(frames: Frames, estimator: Baseline) -> Frames:
    """With cameras in mm where their file does not say its unit
    (``ghpt.calibration.check.units.decide_unit``).
    """
    if frames.detected is None or frames.detected.cameras.unit_known:
        return frames
    file = decide_unit(
        frames.detected.cameras, frames.batch(frames.spread(MEASURED)), estimator, ask=True
    )
    return replace(frames, cameras=file.cameras, detected=replace(frames.detected, cameras=file))


def calibrated(where: str, cameras: CameraSet) -> Cameras:
    """The cameras that the views have. Raises GhptDataError unless they are two or more with
    extrinsics.
    """
    if len(cameras) < 2:
        hint = "A place in space takes two views or more of the same moment."
        raise GhptDataError(
            where, "views", f"there is only {', '.join(cameras.names) or 'none'}", hint
        )
    return cameras.cameras


def evidence(frames: Frames, shards: Shards) -> Iterator[Evidence]:
    """The key points of each shard."""
    for shard in range(len(shards)):
        batch = frames.batch(np.array(shards.rows(shard)))
        yield Evidence(batch.key_points, batch.valid, None)
