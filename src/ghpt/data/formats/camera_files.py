"""People's own camera files: Pose2Sim, aniposelib, caliscope, freemocap, OpenCV, EasyMocap,
Panoptic, Human3.6M and COLMAP.

All are read as world to camera, mm. Pose2Sim's and caliscope's TOML are in metres, Panoptic in
centimetres, Human3.6M in mm. COLMAP's models have a unit of their own, aniposelib's and OpenCV's
files that of the calibration board: they are taken to be in metres until the size of the person
tells (``ghpt.calibration.check.units``).
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from ghpt.data.formats.colmap import is_colmap, read_colmap
from ghpt.data.formats.names import Name, chosen_name
from ghpt.data.formats.opencv_yml import read_yml
from ghpt.data.formats.validate import (
    MOST_VIEWS,
    SMALL_JSON,
    check_cameras,
    check_view_count,
    numbers_in,
    open_input,
    read_flag,
    read_json,
    read_name,
)
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import CameraSet
from ghpt.geometry.rotations import vector_to_matrix

_MM_PER_M = 1000.0
_MM_PER_CM = 10.0
_LARGEST = 1 << 19
_DEEPEST = 100
"""Bytes of a TOML file; parts of a key in it, which cost their square to read."""
_MOST_TABLES = 10 * MOST_VIEWS
"""In a TOML file, with the rows of matrices that begin a line."""
_LARGEST_NUMBER = 1e15
"""No focal length or distance; its square would still be one, though."""
_FIELDS = ("matrix", "distortions", "rotation", "translation")
_FORMATS = (
    "Known: TOML of Pose2Sim, aniposelib, caliscope or freemocap; intri.yml (with extri.yml beside "
    "it) of OpenCV or EasyMocap; calibration JSON of CMU Panoptic; camera-parameters.json of "
    "Human3.6M; a folder with a COLMAP model."
)


@dataclass(frozen=True)
class _Entry:
    """One camera of a file, in the file's own unit of length."""

    name: str
    other: str
    K: Any
    distortion: Any
    size: Any = None
    R: Any = None
    """A 3x3 matrix or a rotation vector."""
    t: Any = None


def read_cameras(
    path: str | Path, subject: Name = None, unit_mm: int | float | None = None
) -> CameraSet:
    """The cameras of a file, or of a folder with intri.yml or a COLMAP model; the format is
    recognised by content.

    ``subject`` chooses of a Human3.6M file, which has other extrinsics for each. ``unit_mm`` is the
    length of the file's unit where that is not the format's own, or where the format has none.
    Raises GhptDataError, naming file, field and mend, for anything that is not a pinhole camera
    with the lens of ``ghpt.geometry.lens``: fisheye lenses among it.
    """
    path = Path(path)
    if unit_mm is not None and not 0 < unit_mm < float("inf"):
        raise GhptDataError(
            path, "unit_mm", f"is {unit_mm}", "Give the length of the file's unit in mm."
        )
    given = None if unit_mm is None else float(unit_mm)
    if path.is_dir() and is_colmap(path):
        entries = [
            _Entry(c.name, c.other, c.K, c.distortion, c.size, c.R, c.t) for c in read_colmap(path)
        ]
        return replace(
            _checked(path, "COLMAP", entries, given or _MM_PER_M), unit_known=given is not None
        )
    if path.is_dir():
        path = path / "intri.yml"
    with open_input(path) as handle:
        start = handle.read(256).lstrip(b"\xef\xbb\xbf \t\r\n")
    if start.startswith(b"%YAML"):
        file = _checked(path, "OpenCV", _opencv(path), given or _MM_PER_M)
        return replace(file, unit_known=given is not None)
    if start.startswith((b"{", b"\xff\xfe{", b"\xfe\xff\0{")):
        content = read_json(path, SMALL_JSON)
        if isinstance(content, dict) and "intrinsics" in content:
            return _checked(path, "Human3.6M", _human36m(path, content, subject), given or 1.0)
        return _checked(path, "Panoptic", _panoptic(path, content), given or _MM_PER_CM)
    file = _checked(path, *_toml(path), given or _MM_PER_M)
    return replace(file, unit_known=given is not None or file.format != "aniposelib")


def _toml(path: Path) -> tuple[str, list[_Entry]]:
    with open_input(path) as handle:
        data = handle.read(_LARGEST + 1)
    if len(data) > _LARGEST:
        raise GhptDataError(
            path, "", f"has more than {_LARGEST >> 10} KiB", "Check that this is the right file."
        )
    if data.count(b"\n[") > _MOST_TABLES:
        raise GhptDataError(path, "", f"has more than {_MOST_TABLES} tables", _FORMATS)
    if any(part.count(b".") > _DEEPEST for part in re.split(rb"[=,\n]", data)):
        raise GhptDataError(path, "", f"has a key of more than {_DEEPEST} parts", _FORMATS)
    try:
        content = tomllib.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise GhptDataError(
            path, "", f"is no camera file: not TOML either ({error})", _FORMATS
        ) from error
    nested = content.get("cameras")
    tables = nested if isinstance(nested, dict) else content
    entries = []
    for key, table in tables.items():
        if not isinstance(table, dict) or not any(field in table for field in _FIELDS):
            continue
        if not read_flag(path, f"{key}.ignore", table.get("ignore", False)):
            entries.append(_toml_camera(path, key, table, nested is tables))
    known = (
        "caliscope"
        if nested is tables
        else "Pose2Sim"
        if any("fisheye" in t for t in tables.values() if isinstance(t, dict))
        else "aniposelib"
    )
    return known, entries


def _toml_camera(path: Path, key: str, table: Mapping[str, Any], numbered: bool) -> _Entry:
    if read_flag(path, f"{key}.fisheye", table.get("fisheye", False)):
        raise GhptDataError(
            path,
            f"{key}.fisheye",
            "is true: fisheye lenses are not supported",
            "Undistort the images or the key points first, and give the pinhole camera.",
        )
    for field in ("matrix", "distortions"):
        if field not in table:
            raise GhptDataError(
                path, f"{key}.{field}", "is missing", "Calibrate the intrinsics of this camera."
            )
    other = f"cam_{key}" if numbered and key.isdigit() else key
    name = read_name(path, f"{key}.name", table.get("name", other))
    return _Entry(
        name,
        other,
        table["matrix"],
        table["distortions"],
        table.get("size"),
        table.get("rotation"),
        table.get("translation"),
    )


def _opencv(path: Path) -> list[_Entry]:
    intrinsic = read_yml(path)
    beside = path.with_name(path.name.replace("intri", "extri"))
    extrinsic = read_yml(beside) if beside != path and beside.is_file() else intrinsic
    names = intrinsic.get("names")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise GhptDataError(
            path, "names", "is not a list of the cameras' names", "Write it as EasyMocap does."
        )
    check_view_count(path, len(names))
    entries = []
    for name in names:
        if f"K_{name}" not in intrinsic:
            raise GhptDataError(
                path, f"K_{name}", "is missing", "Calibrate the intrinsics of this camera."
            )
        lens = intrinsic.get(f"dist_{name}", intrinsic.get(f"D_{name}"))
        if lens is None and any(key.startswith(("dist_", "D_")) for key in intrinsic):
            problem = "is missing, and other cameras have it"
            raise GhptDataError(
                path, f"dist_{name}", problem, "Write zeros if this lens does not distort."
            )
        size = [intrinsic.get(f"{side}_{name}") for side in "WH"]
        vector = extrinsic.get(f"R_{name}")
        matrix = extrinsic.get(f"Rot_{name}")
        entries.append(
            _Entry(
                name,
                "",
                intrinsic[f"K_{name}"],
                [0.0] * 5 if lens is None else lens,
                None if None in size else size,
                vector if matrix is None else matrix,
                extrinsic.get(f"T_{name}"),
            )
        )
    return entries


def _human36m(path: Path, content: Mapping[str, Any], subject: Name) -> list[_Entry]:
    """karfly's file: R and t take the world (mm) to the camera, unlike those of the data set's own
    XML.
    """
    intrinsics = content["intrinsics"]
    extrinsics = content.get("extrinsics", {})
    for field, value in (("intrinsics", intrinsics), ("extrinsics", extrinsics)):
        if not isinstance(value, dict) or not all(
            isinstance(part, dict) for part in value.values()
        ):
            raise GhptDataError(path, field, "is not an object of objects", "Get the file again.")
    if subject is not None:
        subject = chosen_name(subject, extrinsics)
    elif len(extrinsics) == 1:
        subject = next(iter(extrinsics))
    if subject not in extrinsics and (extrinsics or subject is not None):
        problem = (
            "the extrinsics are different for each subject"
            if subject is None
            else f"there is no {subject!r}"
        )
        raise GhptDataError(
            path, "subject", problem, f"Choose one of {', '.join(extrinsics)}: subject=..."
        )
    poses = extrinsics[subject] if subject is not None else {}
    entries = []
    for name, camera in intrinsics.items():
        pose = poses.get(name, {})
        for field in ("calibration_matrix", "distortion"):
            if field not in camera:
                raise GhptDataError(
                    path, f"intrinsics.{name}.{field}", "is missing", "Get the file again."
                )
        if not isinstance(pose, dict):
            raise GhptDataError(
                path, f"extrinsics.{subject}.{name}", "is not an object", "Get the file again."
            )
        entries.append(
            _Entry(
                name,
                "",
                camera["calibration_matrix"],
                camera["distortion"],
                None,
                pose.get("R"),
                pose.get("t"),
            )
        )
    return entries


def _panoptic(path: Path, content: Any) -> list[_Entry]:
    cameras = content.get("cameras") if isinstance(content, dict) else None
    if not isinstance(cameras, list) or not all(isinstance(camera, dict) for camera in cameras):
        raise GhptDataError(path, "cameras", "is not a list of cameras", _FORMATS)
    check_view_count(path, len(cameras))
    high = [camera for camera in cameras if camera.get("type", "hd") == "hd"]
    for camera in high:
        for field in ("name", "K", "distCoef"):
            if field not in camera:
                raise GhptDataError(
                    path,
                    f"camera {camera.get('name')}, {field}",
                    "is missing",
                    "Get the file again.",
                )
    names = [read_name(path, "name", camera["name"]) for camera in high]
    return [
        _Entry(name, "", c["K"], c["distCoef"], c.get("resolution"), c.get("R"), c.get("t"))
        for name, c in zip(names, high, strict=True)
    ]


def _checked(path: Path, form: str, entries: Sequence[_Entry], mm_per_unit: float) -> CameraSet:
    if not entries:
        raise GhptDataError(path, "", "holds 0 cameras", _FORMATS)
    check_view_count(path, len(entries))
    names = tuple(entry.name for entry in entries)
    K = np.stack([_numbers(path, e.name, "matrix", e.K, (9,)).reshape(3, 3) for e in entries])
    lens = np.stack(
        [
            np.resize(np.append(_numbers(path, e.name, "distortion", e.distortion, (4, 5)), 0), 5)
            for e in entries
        ]
    )
    poses = [_pose(path, e, mm_per_unit) for e in entries]
    known = all(pose is not None for pose in poses)
    R, t = (
        np.stack(part)
        for part in zip(*(pose or (np.eye(3), np.zeros(3)) for pose in poses), strict=True)
    )
    # what is not all the same tells the cameras apart: a file before extrinsic calibration has
    # zeros for all
    known = known and bool((np.abs(R - R[0]) > 0).any() or (np.abs(t - t[0]) > 0).any())
    cameras, distortion = check_cameras(path, names, K, R, t, lens)
    sizes = [_size(path, entry) for entry in entries]
    return CameraSet(
        path=str(path),
        format=form,
        names=names,
        other_names=tuple(entry.other for entry in entries),
        K=cameras.K,
        distortion=torch.from_numpy(distortion),
        size=None if None in sizes else torch.tensor(sizes, dtype=torch.int64),
        R=cameras.R if known else None,
        t=cameras.t if known else None,
        unit_mm=mm_per_unit,
    )


def _pose(path: Path, entry: _Entry, mm_per_unit: float) -> tuple[np.ndarray, np.ndarray] | None:
    # caliscope writes "null" where there is none
    if _absent(entry.R) or _absent(entry.t):
        return None
    rotation = _numbers(path, entry.name, "rotation", entry.R, (3, 9))
    vector = torch.from_numpy(rotation) if rotation.size == 3 else None
    R = rotation.reshape(3, 3) if vector is None else vector_to_matrix(vector).numpy()
    return R, _numbers(path, entry.name, "translation", entry.t, (3,)) * mm_per_unit


def _absent(value: object) -> bool:
    return value is None or (isinstance(value, str | list) and value in ("null", "", []))


def _size(path: Path, entry: _Entry) -> tuple[int, int] | None:
    if entry.size is None:
        return None
    width, height = _numbers(path, entry.name, "size", entry.size, (2,))
    if not (1 <= width <= 1e6 and 1 <= height <= 1e6):
        problem = f"is {width:g} x {height:g}"
        raise GhptDataError(
            path, f"camera {entry.name}, size", problem, "Give width and height in pixels."
        )
    return round(width), round(height)


def _numbers(
    path: Path, name: str, field: str, value: Any, sizes: tuple[int, ...]
) -> Float[np.ndarray, " N"]:
    """As many finite, sane numbers as one of ``sizes``, flat: of a list, a row or a column; 9 also
    of 3 x 3.

    Raises GhptDataError for another shape, and for what is no number: true, or a text.
    """
    array = numbers_in(value)
    array = np.empty(0) if array is None else array.squeeze()
    flat = array.ravel()
    shaped = array.ndim == 1 or array.shape == (3, 3)
    if not shaped or flat.size not in sizes or not (np.abs(flat) < _LARGEST_NUMBER).all():
        expected = " or ".join(map(str, sizes))
        problem = f"is not {expected} finite numbers"
        raise GhptDataError(
            path, f"camera {name}, {field}", problem, "Check how the file was written."
        )
    return flat
