"""A camera whose fields have any of the names that programs give them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from ghpt.data.formats.camera_entry import CameraEntry
from ghpt.data.formats.validate import numbers_in, read_flag, read_name
from ghpt.errors import GhptDataError
from ghpt.geometry.rotations import quaternion_to_matrix

_FIELDS = {
    "K": (
        "k",
        "intrinsicmat",
        "intrinsic",
        "intrinsics",
        "intrinsicmatrix",
        "cameramatrix",
        "matrix",
        "mtx",
    ),
    "distortion": (
        "distcoef",
        "distcoeffs",
        "distortion",
        "distortions",
        "distortioncoefficients",
        "distortioncoeffs",
        "dist",
        "coeffs",
        "d",
    ),
    "R": ("r", "rotation", "rotationmatrix", "extrinsicr", "rot", "rvec", "quaternion", "quat"),
    "t": ("t", "translation", "translationvector", "extrinsict", "tvec"),
    "qvec": ("qvec",),
    "pose": (
        "extrinsic",
        "extrinsics",
        "extrinsicmatrix",
        "rt",
        "worldtocamera",
        "worldtocam",
        "world2camera",
        "w2c",
    ),
    "inverse": ("cameratoworld", "camtoworld", "camera2world", "cam2world", "c2w"),
    "size": ("size", "imagesize", "resolution", "imgsize"),
    "width": ("width", "imagewidth", "w"),
    "height": ("height", "imageheight", "h"),
}
"""Field -> its names, without case and separators."""
_PINHOLE = (("fx", "flx"), ("fy", "fly"), ("cx", "ppx"), ("cy", "ppy"))
"""Intrinsics of single numbers, pixels."""
_QUATERNION = ("qw", "qx", "qy", "qz")
_MODELS = {
    "plumb_bob": False,
    "radtan": False,
    "rational_polynomial": False,
    "equidistant": True,
    "fisheye": True,
}
"""ROS' and Kalibr's names of lenses; whether they are fisheyes."""
_LENS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""A lens of single numbers, in OpenCV's order."""


def camera_from_fields(path: Path, name: str, camera: Mapping[str, Any]) -> CameraEntry:
    """Return a camera of a JSON object or a pickled dict.

    ``name`` is what it is called where it does not say so itself. The matrix K may have a row and a
    column more than 3, or be the four numbers fx, fy, cx, cy. The extrinsics may be one matrix of
    3x4 or 4x4; one that is called ``camera_to_world`` is that of the camera in the world, as are
    all where ``world2cam`` is false. A quaternion is ``qvec``, w first. Raises GhptDataError for a
    camera without K, and for one in another convention than OpenCV's.
    """
    fields = _flat_fields(camera)
    found = {field: _first(fields, names) for field, names in _FIELDS.items()}
    K = _intrinsics(fields)
    if K is None:
        hint = "Give the 3x3 matrix of the intrinsics as K."
        raise GhptDataError(path, f"camera {name}, K", "is missing", hint)
    convention = fields.get("convention", "opencv")
    if convention != "opencv":
        problem = f"is {convention!r}"
        hint = "Write it in OpenCV's convention: x right, y down, z forward."
        raise GhptDataError(path, f"camera {name}, convention", problem, hint)
    size = found["size"]
    if size is None and found["width"] is not None and found["height"] is not None:
        size = [found["width"], found["height"]]
    world_to_camera = read_flag(path, f"{name}.world2cam", fields.get("world2cam", True))
    R = _rotation(path, name, fields)
    t = found["t"]
    if found["pose"] is not None:
        R, t = _split_pose(found["pose"])
    elif found["inverse"] is not None:
        R, t = _split_pose(found["inverse"])
        world_to_camera = False
    return CameraEntry(
        name=read_name(path, "name", fields.get("name", fields.get("cameraname", name))),
        other_name=name,
        K=K,
        distortion=_lens(fields, found["distortion"]),
        size=size,
        R=R,
        t=t,
        fisheye=_is_fisheye(path, name, fields),
        to_world=not world_to_camera,
    )


def is_camera(value: object) -> bool:
    """Return whether a value is an object with intrinsics."""
    return isinstance(value, dict) and _intrinsics(_flat_fields(value)) is not None


def camera_from_lines(path: Path, name: str, camera: Mapping[str, Any]) -> CameraEntry:
    """Return a camera of a text whose last lines may be lost: it must have a lens, too.

    Raises GhptDataError as `camera_from_fields`.
    """
    fields = _flat_fields(camera)
    if _first(fields, (*_FIELDS["distortion"], _LENS[0])) is None:
        hint = "Write zeros if this lens does not distort."
        raise GhptDataError(path, f"camera {name}, distortion", "is missing", hint)
    return camera_from_fields(path, name, camera)


def cameras_by_name(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the cameras among an object's values.

    One alone is none of several: it is a part of the camera that the object itself is.
    """
    cameras = {name: value for name, value in content.items() if is_camera(value)}
    return cameras if len(cameras) > 1 else {}


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


def _intrinsics(fields: Mapping[str, Any]) -> object:
    """Return K, of a 3x3 or 4x4, of four numbers or of single ones; None where there is none."""
    K = _first(fields, _FIELDS["K"])
    if K is None:
        K = [_first(fields, names) for names in _PINHOLE]
        if None in K:
            return None
    numbers = numbers_in(K)
    if numbers is not None and numbers.shape == (4,):
        fx, fy, cx, cy = numbers.tolist()
        return [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
    if numbers is not None and numbers.shape == (4, 4):
        # some write the third row as the fourth
        return np.vstack([numbers[:2, :3], [0.0, 0.0, 1.0]])
    return K


def _rotation(path: Path, name: str, fields: Mapping[str, Any]) -> object:
    """Return a matrix or vector. Raises GhptDataError for a quaternion of an unknown order."""
    single = [fields.get(part) for part in _QUATERNION]
    quaternion = _first(fields, _FIELDS["qvec"]) if None in single else single
    if quaternion is not None:
        numbers = numbers_in(quaternion)
        is_one = numbers is not None and numbers.shape == (4,) and bool(numbers.any())
        return _matrix_of(numbers) if is_one and numbers is not None else quaternion
    R = _first(fields, _FIELDS["R"])
    numbers = numbers_in(R)
    if numbers is not None and numbers.squeeze().shape == (4,):
        problem = "is a quaternion, and whether w is its first number is not said"
        hint = "Write it as qvec, w first, or as a 3x3 matrix."
        raise GhptDataError(path, f"camera {name}, rotation", problem, hint)
    return R


def _is_fisheye(path: Path, name: str, fields: Mapping[str, Any]) -> bool:
    """Return whether the lens is Kannala and Brandt's. Raises GhptDataError for one not known."""
    model = fields.get("distortionmodel")
    if model is None:
        return read_flag(path, f"{name}.fisheye", fields.get("fisheye", False))
    if not isinstance(model, str) or model not in _MODELS:
        hint = f"Known: {', '.join(_MODELS)}. Calibrate it with one of them."
        raise GhptDataError(path, f"camera {name}, distortion_model", f"is {model!r}", hint)
    return _MODELS[model]


def _matrix_of(quaternion: Float[np.ndarray, " 4"]) -> Float[np.ndarray, "3 3"]:
    return quaternion_to_matrix(torch.from_numpy(quaternion)).numpy()


def _split_pose(pose: object) -> tuple[object, object]:
    """Return R and t of a 3x4 or 4x4 matrix; what is none is left to be found wrong."""
    numbers = numbers_in(pose)
    if numbers is None or numbers.shape not in ((3, 4), (4, 4)):
        return pose, pose
    return numbers[:3, :3], numbers[:3, 3]
