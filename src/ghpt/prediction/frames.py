"""The frames of a recording, read as they are asked for, with all that predicting them takes."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from ghpt.data.camera_files import CameraFile
from ghpt.data.detections import undistorted
from ghpt.data.key_points import KeyPoints
from ghpt.data.skeletons import joints17
from ghpt.data.views import look_through, matched
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import Cameras
from ghpt.recording import KeyPointBatch, Recording
from ghpt.skeleton import JOINTS

_CHECKED = 2000
"""Frames, evenly spread, on which the views are checked against their cameras."""
_STAMPED = 4096
_MEND = "Calibrate first (python calibrate.py keypoints=... cameras=...), and give the rig.toml that it writes."

Seen = tuple[Float[np.ndarray, "T V J 2"], Float[np.ndarray, "T V J"], Bool[np.ndarray, "T V J"]]
"""Undistorted pixels, confidences and what is seen, of the 17 joints."""


@dataclass(frozen=True)
class Frames:
    """T frames of one person before V calibrated cameras."""

    title: str
    source: str
    """``embedded`` or the path of the key points."""
    camera_names: tuple[str, ...]
    cameras: Cameras
    """Leading dimension V, mm, float64."""
    frame: Int[np.ndarray, " T"]
    """The recording's own numbers, rising."""
    rate_hz: float | None
    read: Callable[[Int[np.ndarray, " N"]], Seen]
    """The key points of some rows."""

    def __len__(self) -> int:
        return len(self.frame)

    def batch(self, rows: Int[np.ndarray, " N"]) -> KeyPointBatch:
        """Some rows; a frame's ``sample`` is its own number, so its random draws are the same in any batch."""
        key_points, confidence, seen = (torch.from_numpy(values) for values in self.read(rows))
        count, rig = len(rows), self.cameras
        return KeyPointBatch(
            sample=torch.from_numpy(self.frame[rows]), recording=torch.zeros(count, dtype=torch.int64),
            cameras=Cameras(*(x.expand(count, *x.shape) for x in (rig.K, rig.R, rig.t))),
            key_points=key_points, confidence=confidence, seen=seen,
            truth=torch.zeros(count, len(JOINTS), 3), truth_seen=torch.zeros(count, len(JOINTS), dtype=torch.bool),
        )  # fmt: skip

    def stamp(self) -> str:
        """SHA-256 of everything that a prediction depends on."""
        digest = hashlib.sha256(repr((self.camera_names, len(self), self.rate_hz)).encode())
        for value in (self.cameras.K, self.cameras.R, self.cameras.t):
            digest.update(value.double().numpy().tobytes())
        digest.update(self.frame.astype(np.int64).tobytes())
        for start in range(0, len(self), _STAMPED):
            for values in self.read(np.arange(start, min(start + _STAMPED, len(self)))):
                digest.update(np.ascontiguousarray(values).tobytes())
        return digest.hexdigest()


def frames_of_files(
    points: KeyPoints, cameras: CameraFile, match: Mapping[str, str] | None, views: Sequence[str] | None, title: str,
) -> Frames:  # fmt: skip
    """A user's key points before their cameras. Raises GhptDataError for views without cameras (and the reverse),
    fewer than two, cameras without extrinsics, and images of another size than the cameras'."""
    pairs = matched(points.path, points.views, cameras, match or {}, views)
    at, ordered = [view for view, _ in pairs], cameras.select([camera for _, camera in pairs])
    if len(at) < 2:
        mend = "A place in space takes two views or more of the same moment."
        raise GhptDataError(points.path, "views", f"there is only {', '.join(ordered.names) or 'none'}", mend)
    if ordered.cameras is None:
        raise GhptDataError(cameras.path, "rotation, translation", "there are no extrinsics of all cameras", _MEND)
    count = len(points.frame)
    spread = np.unique(np.linspace(0, count - 1, min(_CHECKED, count)).astype(int))
    look_through(_rows(points, spread), cameras, match, views)

    def read(rows: Int[np.ndarray, " N"]) -> Seen:
        part = _rows(points, rows)
        pixels, seen = np.zeros((*part.seen[:, at].shape, 2), np.float32), part.seen[:, at].copy()
        for view, of in enumerate(at):
            K, lens = ordered.K[view].numpy(), ordered.distortion[view].numpy()
            pixels[:, view], seen[:, view] = undistorted(part.key_points[:, of], seen[:, view], K, lens)
        return joints17(points.path, points.joints, pixels, part.confidence[:, at], seen)

    return Frames(title, points.path, ordered.names, ordered.cameras, points.frame, points.rate_hz, read)


def frames_of_recording(recording: Recording, source: str, title: str) -> Frames:
    """A recording of a data set; its truth is left behind."""

    def read(rows: Int[np.ndarray, " N"]) -> Seen:
        return tuple(np.array(getattr(recording, field)[rows]) for field in ("key_points", "confidence", "seen"))

    frame = np.array(recording.frame, dtype=np.int64)
    return Frames(title, source, recording.camera_names, recording.cameras, frame, recording.rate_hz, read)


def _rows(points: KeyPoints, rows: Int[np.ndarray, " N"]) -> KeyPoints:
    parts = {name: getattr(points, name)[rows] for name in ("frame", "key_points", "confidence", "seen")}
    return replace(points, **parts)
