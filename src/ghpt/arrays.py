"""Arrays of people's own, NumPy's or torch's, as the types that the rest of the project takes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ghpt.data.people.detections import Detections
from ghpt.data.points import KeyPoints
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import Cameras, CameraSet
from ghpt.skeleton import JOINTS

Array = np.ndarray | Tensor
CamerasLike = CameraSet | tuple[Array, Array, Array]
"""Cameras of a file, or K, R and t of ideal pinholes."""
ARRAYS = "arrays"
"""What errors call the input, and files its source."""


def as_tensor(values: Array) -> Tensor:
    """Return an array as a float64 tensor on the CPU."""
    return torch.as_tensor(values).detach().to("cpu", torch.float64)


def as_camera_set(cameras: CamerasLike | Array) -> CameraSet:
    """Return named cameras; those of K alone have no extrinsics."""
    if isinstance(cameras, CameraSet):
        return cameras
    if not isinstance(cameras, tuple):
        K = as_tensor(cameras)
        unknown = (torch.eye(3).expand(K.shape), K.new_zeros(len(K), 3))
        return replace(as_camera_set((K, *unknown)), R=None, t=None)
    K, R, t = (as_tensor(part) for part in cameras)
    shapes = (K.shape[1:], R.shape[1:], t.shape[1:])
    if shapes != ((3, 3), (3, 3), (3,)) or not len(K) == len(R) == len(t):
        shown = ", ".join(str(list(part.shape)) for part in (K, R, t))
        problem = f"K, R and t have the shapes {shown}"
        raise GhptDataError("cameras", "", problem, "Give [V 3 3], [V 3 3] and [V 3].")
    names = [f"cam_{view:02d}" for view in range(len(K))]
    return CameraSet.from_cameras(names, Cameras(K, R, t), path="cameras")


def as_detections(
    key_points: Array | Detections,
    cameras: CameraSet,
    confidence: Array | None = None,
    rate_hz: int | float | None = None,
) -> Detections:
    """Return key points of the 17 joints as one person's detections in the views of cameras."""
    rate = None if rate_hz is None else float(rate_hz)
    if isinstance(key_points, Detections):
        return key_points if rate is None else replace(key_points, rate_hz=rate)
    points = as_key_points(key_points, confidence, len(cameras))
    if points.valid.shape[-1] != len(JOINTS):
        problem = f"there are {points.valid.shape[-1]} joints, not {len(JOINTS)}"
        hint = "Give them in the order of ghpt.skeleton.JOINTS, NaN where there is none."
        raise GhptDataError("key_points", "", problem, hint)
    frame = np.arange(len(points))
    return Detections.of_person(ARRAYS, cameras.names, JOINTS, frame, points, rate)


def as_key_points(key_points: Array, confidence: Array | None, views: int) -> KeyPoints:
    """Return key points and what is valid of them. Raises GhptDataError for a wrong shape."""
    pixels = as_tensor(key_points).numpy()
    if pixels.ndim != 4 or pixels.shape[1] != views or pixels.shape[-1] != 2:
        problem = f"has the shape {list(pixels.shape)}, for {views} cameras"
        raise GhptDataError("key_points", "", problem, f"Give [T {views} J 2].")
    valid = np.isfinite(pixels).all(-1)
    if confidence is None:
        sure = np.ones(valid.shape)
    else:
        sure = as_tensor(confidence).numpy()
        if sure.shape != valid.shape:
            problem = f"has the shape {list(sure.shape)}"
            raise GhptDataError("confidence", "", problem, f"Give {list(valid.shape)}.")
    valid &= sure > 0
    return KeyPoints(np.where(valid[..., None], pixels, 0.0), np.nan_to_num(sure), valid)
