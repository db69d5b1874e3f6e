"""People's own camera files.

They are those of Pose2Sim, aniposelib, caliscope, freemocap, OpenCV, EasyMocap, Panoptic, Human3.6M
and COLMAP, and all are read as world to camera, mm. Pose2Sim's and caliscope's TOML are in metres,
Panoptic in centimetres, Human3.6M in mm. COLMAP's models have a unit of their own, aniposelib's and
OpenCV's files that of the calibration board: they are taken to be in metres until the size of the
person tells (``ghpt.calibration.check.units``).
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from ghpt.clock import Clock
from ghpt.data.formats.camera_entry import CameraEntry
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


def read_cameras(
    path: str | Path, subject: Name = None, unit_mm: int | float | None = None
) -> CameraSet:
    """Return the cameras of a file, or of a folder with intri.yml or a COLMAP model.

    The format is recognised by content. ``subject`` chooses of a Human3.6M file, which has other
    extrinsics for each. ``unit_mm`` is the length of the file's unit where that is not the format's
    own, or where the format has none. Raises GhptDataError, naming file, field and hint, for
    anything that is not a pinhole camera with the lens of ``ghpt.geometry.lens``: fisheye lenses
    among it.
    """
    path = Path(path)
    if unit_mm is not None and not 0 < unit_mm < float("inf"):
        hint = "Give the length of the file's unit in mm."
        raise GhptDataError(path, "unit_mm", f"is {unit_mm}", hint)
    if path.is_dir() and not is_colmap(path):
        path = path / "intri.yml"
    content = _read_entries(path, subject)
    unit = content.unit_mm if unit_mm is None else float(unit_mm)
    return _camera_set(path, content, unit, content.unit_known or unit_mm is not None)


@dataclass(frozen=True)
class _Content:
    """What a file of a format holds."""

    format: str
    entries: Sequence[CameraEntry]
    unit_mm: float
    """The format's unit of length, or what it is taken for."""
    unit_known: bool = True


def _read_entries(path: Path, subject: Name) -> _Content:
    if path.is_dir():
        return _Content("COLMAP", read_colmap(path), _MM_PER_M, unit_known=False)
    with open_input(path) as handle:
        start = handle.read(256).lstrip(b"\xef\xbb\xbf \t\r\n")
    if start.startswith(b"%YAML"):
        return _Content("OpenCV", _opencv(path), _MM_PER_M, unit_known=False)
    if start.startswith((b"{", b"\xff\xfe{", b"\xfe\xff\0{")):
        content = read_json(path, SMALL_JSON)
        if isinstance(content, dict) and "intrinsics" in content:
            return _Content("Human3.6M", _human36m(path, content, subject), 1.0)
        return _Content("Panoptic", _panoptic(path, content), _MM_PER_CM)
    form, entries = _toml(path)
    return _Content(form, entries, _MM_PER_M, unit_known=form != "aniposelib")


def _toml(path: Path) -> tuple[str, list[CameraEntry]]:
    content = _parse_toml(path)
    nested = content.get("cameras")
    numbered = isinstance(nested, dict)
    tables = nested if isinstance(nested, dict) else content
    entries = []
    for key, table in tables.items():
        if not isinstance(table, dict) or not any(field in table for field in _FIELDS):
            continue
        if not read_flag(path, f"{key}.ignore", table.get("ignore", False)):
            entries.append(_toml_camera(path, key, table, numbered))
    if numbered:
        return "caliscope", entries
    fisheye = any("fisheye" in table for table in tables.values() if isinstance(table, dict))
    return "Pose2Sim" if fisheye else "aniposelib", entries


def _parse_toml(path: Path) -> dict[str, Any]:
    with open_input(path) as handle:
        data = handle.read(_LARGEST + 1)
    if len(data) > _LARGEST:
        problem = f"has more than {_LARGEST >> 10} KiB"
        raise GhptDataError(path, "", problem, "Check that this is the right file.")
    if data.count(b"\n[") > _MOST_TABLES:
        raise GhptDataError(path, "", f"has more than {_MOST_TABLES} tables", _FORMATS)
    parts = re.split(rb"[=,\n]", data)
    if any(part.count(b".") > _DEEPEST for part in parts):
        raise GhptDataError(path, "", f"has a key of more than {_DEEPEST} parts", _FORMATS)
    try:
        return tomllib.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        problem = f"is no camera file: not TOML either ({error})"
        raise GhptDataError(path, "", problem, _FORMATS) from error


def _toml_camera(path: Path, key: str, table: Mapping[str, Any], numbered: bool) -> CameraEntry:
    if read_flag(path, f"{key}.fisheye", table.get("fisheye", False)):
        problem = "is true: fisheye lenses are not supported"
        hint = "Undistort the images or the key points first, and give the pinhole camera."
        raise GhptDataError(path, f"{key}.fisheye", problem, hint)
    for field in ("matrix", "distortions"):
        if field not in table:
            hint = "Calibrate the intrinsics of this camera."
            raise GhptDataError(path, f"{key}.{field}", "is missing", hint)
    other = f"cam_{key}" if numbered and key.isdigit() else key
    return CameraEntry(
        name=read_name(path, f"{key}.name", table.get("name", other)),
        other_name=other,
        K=table["matrix"],
        distortion=table["distortions"],
        size=table.get("size"),
        R=table.get("rotation"),
        t=table.get("translation"),
        time=table.get("time"),
    )


def _opencv(path: Path) -> list[CameraEntry]:
    intrinsic = read_yml(path)
    beside = path.with_name(path.name.replace("intri", "extri"))
    extrinsic = read_yml(beside) if beside != path and beside.is_file() else intrinsic
    names = intrinsic.get("names")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        problem = "is not a list of the cameras' names"
        raise GhptDataError(path, "names", problem, "Write it as EasyMocap does.")
    check_view_count(path, len(names))
    entries = []
    for name in names:
        if f"K_{name}" not in intrinsic:
            hint = "Calibrate the intrinsics of this camera."
            raise GhptDataError(path, f"K_{name}", "is missing", hint)
        width = intrinsic.get(f"W_{name}")
        height = intrinsic.get(f"H_{name}")
        vector = extrinsic.get(f"R_{name}")
        matrix = extrinsic.get(f"Rot_{name}")
        entry = CameraEntry(
            name=name,
            other_name="",
            K=intrinsic[f"K_{name}"],
            distortion=_opencv_distortion(path, name, intrinsic),
            size=None if width is None or height is None else [width, height],
            R=vector if matrix is None else matrix,
            t=extrinsic.get(f"T_{name}"),
        )
        entries.append(entry)
    return entries


def _opencv_distortion(path: Path, name: str, intrinsic: Mapping[str, object]) -> object:
    distortion = intrinsic.get(f"dist_{name}", intrinsic.get(f"D_{name}"))
    if distortion is not None:
        return distortion
    if any(key.startswith(("dist_", "D_")) for key in intrinsic):
        problem = "is missing, and other cameras have it"
        hint = "Write zeros if this lens does not distort."
        raise GhptDataError(path, f"dist_{name}", problem, hint)
    return [0.0] * 5


def _human36m(path: Path, content: Mapping[str, Any], subject: Name) -> list[CameraEntry]:
    """Return the cameras of karfly's file.

    Its R and t take the world (mm) to the camera, unlike those of the data set's own XML.
    """
    intrinsics = _objects(path, "intrinsics", content["intrinsics"])
    extrinsics = _objects(path, "extrinsics", content.get("extrinsics", {}))
    chosen = _human36m_subject(path, subject, extrinsics)
    poses = {} if chosen is None else extrinsics[chosen]
    entries = []
    for name, camera in intrinsics.items():
        for field in ("calibration_matrix", "distortion"):
            if field not in camera:
                where = f"intrinsics.{name}.{field}"
                raise GhptDataError(path, where, "is missing", "Get the file again.")
        pose = poses.get(name, {})
        if not isinstance(pose, dict):
            where = f"extrinsics.{chosen}.{name}"
            raise GhptDataError(path, where, "is not an object", "Get the file again.")
        entry = CameraEntry(
            name=name,
            other_name="",
            K=camera["calibration_matrix"],
            distortion=camera["distortion"],
            R=pose.get("R"),
            t=pose.get("t"),
        )
        entries.append(entry)
    return entries


def _objects(path: Path, field: str, value: object) -> dict[str, dict[str, Any]]:
    if isinstance(value, dict) and all(isinstance(part, dict) for part in value.values()):
        return value
    raise GhptDataError(path, field, "is not an object of objects", "Get the file again.")


def _human36m_subject(
    path: Path, subject: Name, extrinsics: Mapping[str, dict[str, Any]]
) -> str | None:
    """Return the subject whose extrinsics are wanted; None where the file has none."""
    chosen: str | None
    if subject is not None:
        chosen = chosen_name(subject, extrinsics)
        problem = f"there is no {chosen!r}"
    else:
        chosen = next(iter(extrinsics)) if len(extrinsics) == 1 else None
        problem = "the extrinsics are different for each subject"
    if chosen in extrinsics or (chosen is None and not extrinsics):
        return chosen
    hint = f"Choose one of {', '.join(extrinsics)}: subject=..."
    raise GhptDataError(path, "subject", problem, hint)


def _panoptic(path: Path, content: Any) -> list[CameraEntry]:
    cameras = content.get("cameras") if isinstance(content, dict) else None
    if not isinstance(cameras, list) or not all(isinstance(camera, dict) for camera in cameras):
        raise GhptDataError(path, "cameras", "is not a list of cameras", _FORMATS)
    check_view_count(path, len(cameras))
    entries = []
    for camera in cameras:
        if camera.get("type", "hd") != "hd":
            continue
        for field in ("name", "K", "distCoef"):
            if field not in camera:
                where = f"camera {camera.get('name')}, {field}"
                raise GhptDataError(path, where, "is missing", "Get the file again.")
        entry = CameraEntry(
            name=read_name(path, "name", camera["name"]),
            other_name="",
            K=camera["K"],
            distortion=camera["distCoef"],
            size=camera.get("resolution"),
            R=camera.get("R"),
            t=camera.get("t"),
        )
        entries.append(entry)
    return entries


def _camera_set(path: Path, content: _Content, unit_mm: float, unit_known: bool) -> CameraSet:
    """Check the cameras of a file. Raises GhptDataError."""
    entries = content.entries
    if not entries:
        raise GhptDataError(path, "", "holds 0 cameras", _FORMATS)
    check_view_count(path, len(entries))
    names = tuple(entry.name for entry in entries)
    K = np.stack([_intrinsics(path, entry) for entry in entries])
    distortion = np.stack([_distortion(path, entry) for entry in entries])
    poses = [_pose(path, entry, unit_mm) for entry in entries]
    complete = [pose or (np.eye(3), np.zeros(3)) for pose in poses]
    R = np.stack([pose[0] for pose in complete])
    t = np.stack([pose[1] for pose in complete])
    # what is not all the same tells the cameras apart: a file before extrinsic calibration has
    # zeros for all
    different = (np.abs(R - R[0]) > 0).any() or (np.abs(t - t[0]) > 0).any()
    calibrated = all(pose is not None for pose in poses) and bool(different)
    cameras, distortion = check_cameras(path, names, K, R, t, distortion)
    sizes = [_size(path, entry) for entry in entries]
    return CameraSet(
        path=str(path),
        format=content.format,
        names=names,
        other_names=tuple(entry.other_name for entry in entries),
        K=cameras.K,
        distortion=torch.from_numpy(distortion),
        size=None if None in sizes else torch.tensor(sizes, dtype=torch.int64),
        R=cameras.R if calibrated else None,
        t=cameras.t if calibrated else None,
        unit_mm=unit_mm,
        unit_known=unit_known,
        clock=_clock(path, entries),
    )


def _clock(path: Path, entries: Sequence[CameraEntry]) -> Clock | None:
    """Return when the cameras' frames are taken; None where no camera says it."""
    if all(entry.time is None for entry in entries):
        return None
    pairs = [
        (1.0, 0.0) if entry.time is None else _rate_and_shift(path, entry) for entry in entries
    ]
    return Clock(tuple(rate for rate, _ in pairs), tuple(shift for _, shift in pairs))


def _rate_and_shift(path: Path, entry: CameraEntry) -> tuple[float, float]:
    table = entry.time if isinstance(entry.time, dict) else {}
    values = [table.get("rate", 1.0), table.get("shift", 0.0)]
    rate, shift = _numbers(path, entry.name, "time", values, (2,)).tolist()
    if not isinstance(entry.time, dict) or rate <= 0:
        problem = "is not a table of a positive rate and a shift"
        hint = "Write time = {rate = 1.0, shift = 12.5}, or leave it out."
        raise GhptDataError(path, f"camera {entry.name}, time", problem, hint)
    return rate, shift


def _intrinsics(path: Path, entry: CameraEntry) -> Float[np.ndarray, "3 3"]:
    return _numbers(path, entry.name, "matrix", entry.K, (9,)).reshape(3, 3)


def _distortion(path: Path, entry: CameraEntry) -> Float[np.ndarray, " 5"]:
    values = _numbers(path, entry.name, "distortion", entry.distortion, (4, 5))
    return np.resize(np.append(values, 0), 5)


def _pose(
    path: Path, entry: CameraEntry, mm_per_unit: float
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]] | None:
    # caliscope writes "null" where there is none
    if _absent(entry.R) or _absent(entry.t):
        return None
    rotation = _numbers(path, entry.name, "rotation", entry.R, (3, 9))
    if rotation.size == 3:
        R = vector_to_matrix(torch.from_numpy(rotation)).numpy()
    else:
        R = rotation.reshape(3, 3)
    translation = _numbers(path, entry.name, "translation", entry.t, (3,))
    return R, translation * mm_per_unit


def _absent(value: object) -> bool:
    return value is None or (isinstance(value, str | list) and value in ("null", "", []))


def _size(path: Path, entry: CameraEntry) -> tuple[int, int] | None:
    if entry.size is None:
        return None
    width, height = _numbers(path, entry.name, "size", entry.size, (2,))
    if not (1 <= width <= 1e6 and 1 <= height <= 1e6):
        problem = f"is {width:g} x {height:g}"
        hint = "Give width and height in pixels."
        raise GhptDataError(path, f"camera {entry.name}, size", problem, hint)
    return round(width), round(height)


def _numbers(
    path: Path, name: str, field: str, value: object, sizes: tuple[int, ...]
) -> Float[np.ndarray, " N"]:
    """Return as many finite, sane numbers as one of ``sizes``, flat.

    They come from a list, a row or a column; 9 also from 3 x 3. Raises GhptDataError for another
    shape, and for what is no number: true, or a text.
    """
    found = numbers_in(value)
    array = np.empty(0) if found is None else found.squeeze()
    flat = array.ravel()
    shaped = array.ndim == 1 or array.shape == (3, 3)
    if not shaped or flat.size not in sizes or not (np.abs(flat) < _LARGEST_NUMBER).all():
        expected = " or ".join(map(str, sizes))
        problem = f"is not {expected} finite numbers"
        hint = "Check how the file was written."
        raise GhptDataError(path, f"camera {name}, {field}", problem, hint)
    return flat
