"""A camera whose fields have any of the names that programs give them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ghpt.data.formats.camera_entry import CameraEntry
from ghpt.data.formats.validate import numbers_in, read_flag, read_name
from ghpt.errors import GhptDataError

_FIELDS = {
    "K": ("k", "intrinsicmat", "intrinsic", "intrinsicmatrix", "cameramatrix", "matrix", "mtx"),
    "distortion": (
        "distcoef",
        "distcoeffs",
        "distortion",
        "distortions",
        "distortioncoefficients",
        "dist",
        "d",
    ),
    "R": ("r", "rotation", "rotationmatrix", "extrinsicr", "rot", "rvec"),
    "t": ("t", "translation", "translationvector", "extrinsict", "tvec"),
    "pose": ("extrinsic", "extrinsics", "extrinsicmatrix", "rt", "worldtocamera", "w2c"),
    "size": ("size", "imagesize", "resolution", "imgsize"),
    "width": ("width", "imagewidth", "w"),
    "height": ("height", "imageheight", "h"),
}
"""Field -> its names, without case and separators."""
_LENS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""A lens of single numbers, in OpenCV's order."""


def camera_from_fields(path: Path, name: str, camera: Mapping[str, Any]) -> CameraEntry:
    """Return a camera of a JSON object or a pickled dict.

    ``name`` is what it is called where it does not say so itself. The matrix K may have a row and a
    column more than 3, and the extrinsics may be one matrix of 3x4 or 4x4; ``world2cam`` false says
    that they are those of the camera in the world. Raises GhptDataError for a camera without K, and
    for one in another convention than OpenCV's.
    """
    fields = _flat_fields(camera)
    found = {field: _first(fields, names) for field, names in _FIELDS.items()}
    if found["K"] is None:
        hint = "Give the 3x3 matrix of the intrinsics as K."
        raise GhptDataError(path, f"camera {name}, K", "is missing", hint)
    convention = fields.get("convention", "opencv")
    if convention != "opencv":
        problem = f"is {convention!r}"
        hint = "Write it in OpenCV's convention: x right, y down, z forward."
        raise GhptDataError(path, f"camera {name}, convention", problem, hint)
    R = found["R"]
    t = found["t"]
    if found["pose"] is not None:
        R, t = _split_pose(found["pose"])
    world_to_camera = fields.get("world2cam", True)
    size = found["size"]
    if size is None and found["width"] is not None and found["height"] is not None:
        size = [found["width"], found["height"]]
    return CameraEntry(
        name=read_name(path, "name", fields.get("name", name)),
        other_name=name,
        K=_square(found["K"]),
        distortion=_lens(fields, found["distortion"]),
        size=size,
        R=R,
        t=t,
        fisheye=read_flag(path, f"{name}.fisheye", fields.get("fisheye", False)),
        to_world=not read_flag(path, f"{name}.world2cam", world_to_camera),
    )


def is_camera(value: object) -> bool:
    """Return whether a value is an object with intrinsics."""
    return isinstance(value, dict) and _first(_flat_fields(value), _FIELDS["K"]) is not None


def _flat_fields(camera: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values by plain name; those of an object within are the camera's own."""
    fields: dict[str, Any] = {}
    for key, value in camera.items():
        inner = value if isinstance(value, dict) else {key: value}
        for name, content in inner.items():
            fields.setdefault(re.sub(r"[^a-z0-9]", "", str(name).lower()), content)
    return fields


def _first(fields: Mapping[str, Any], names: tuple[str, ...]) -> Any:
    return next((fields[name] for name in names if fields.get(name) is not None), None)


def _lens(fields: Mapping[str, Any], distortion: object) -> object:
    if distortion is not None:
        return distortion
    if "k1" not in fields:
        return [0.0] * 5
    return [fields.get(name, 0.0) for name in _LENS]


def _square(K: object) -> object:
    """Return a 3x3 of a 4x4 of intrinsics, whose third row some write as the fourth."""
    numbers = numbers_in(K)
    if numbers is None or numbers.shape != (4, 4):
        return K
    return np.vstack([numbers[:2, :3], [0.0, 0.0, 1.0]])


def _split_pose(pose: object) -> tuple[object, object]:
    """Return R and t of a 3x4 or 4x4 matrix; what is none is left to be found wrong."""
    numbers = numbers_in(pose)
    if numbers is None or numbers.shape not in ((3, 4), (4, 4)):
        return pose, pose
    return numbers[:3, :3], numbers[:3, 3]
