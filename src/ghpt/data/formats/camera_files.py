"""People's own camera files.

They are those of Pose2Sim, aniposelib, caliscope, freemocap, OpenCap, OpenCV, EasyMocap, Panoptic,
Human3.6M, xrmocap and COLMAP, and all are read as world to camera, mm. Pose2Sim's and caliscope's
TOML are in metres, Panoptic in centimetres, Human3.6M and OpenCap in mm. COLMAP's models have a
unit of their own, all others that of the calibration board: they are taken to be in metres until
the size of the person tells (``ghpt.calibration.check.units``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from ghpt.clock import Clock
from ghpt.data.formats.camera_entry import KNOWN_CAMERAS, CameraContent, CameraEntry
from ghpt.data.formats.camera_json import read_camera_json
from ghpt.data.formats.camera_pickle import SUFFIXES, read_camera_pickle
from ghpt.data.formats.camera_toml import read_toml
from ghpt.data.formats.camera_yml import read_opencv
from ghpt.data.formats.colmap import is_colmap, read_colmap
from ghpt.data.formats.names import Name
from ghpt.data.formats.validate import (
    check_cameras,
    check_view_count,
    numbers_in,
    open_input,
)
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import CameraSet
from ghpt.geometry.lens import COEFFICIENTS, fisheye_lens
from ghpt.geometry.rotations import vector_to_matrix

_MM_PER_M = 1000.0
_LARGEST_NUMBER = 1e15
"""No focal length or distance; its square would still be one, though."""
_LENSES = (4, 5, 8, 12, 14)
"""How many coefficients OpenCV's lenses have; of 12 and 14, those after the eighth must be 0."""
_ONE_EACH = ("OpenCap", "JSON", "YAML")
"""Formats of a file for each camera."""
_SUFFIXES = (".toml", ".json", ".yml", ".yaml", *SUFFIXES)
"""Of a file in a folder of cameras."""


def read_cameras(
    path: str | Path, subject: Name = None, unit_mm: int | float | None = None
) -> CameraSet:
    """Return the cameras of a file, or of a folder.

    A folder holds intri.yml, a COLMAP model, one file with all cameras, or a file for each camera,
    beside each other or each in a folder of its own. The format is recognised by content.
    ``subject`` chooses of a Human3.6M file, which has other extrinsics for each. ``unit_mm`` is the
    length of the file's unit where that is not the format's own, or where the format has none.
    Raises GhptDataError, naming file, field and hint, for anything that is not a camera with a lens
    of ``ghpt.geometry.lens``.
    """
    path = Path(path).expanduser()
    if unit_mm is not None and not 0 < unit_mm < float("inf"):
        hint = "Give the length of the file's unit in mm."
        raise GhptDataError(path, "unit_mm", f"is {unit_mm}", hint)
    content = _read_folder(path, subject) if path.is_dir() else _read_file(path, subject)
    if unit_mm is not None:
        content = replace(content, unit_mm=float(unit_mm), unit_known=True)
    return _camera_set(path, content)


def _read_file(path: Path, subject: Name) -> CameraContent:
    with open_input(path) as handle:
        start = handle.read(256).lstrip(b"\xef\xbb\xbf \t\r\n")
    if path.suffix.lower() in SUFFIXES or start.startswith(b"\x80"):
        return read_camera_pickle(path)
    if path.suffix.lower() in (".yml", ".yaml") or start.startswith(b"%YAML"):
        return read_opencv(path)
    if start.startswith((b"{", b"[", b"\xff\xfe{", b"\xfe\xff\0{")) and not _is_table(start):
        return read_camera_json(path, subject)
    return read_toml(path)


def _is_table(start: bytes) -> bool:
    """Return whether a file begins with a table of TOML rather than a list of JSON."""
    line = start.split(b"\n")[0].split(b"#")[0].strip()
    return line.startswith(b"[") and line.endswith(b"]") and b"," not in line


def _read_folder(path: Path, subject: Name) -> CameraContent:
    """Return the cameras of a folder's files. Raises GhptDataError."""
    if is_colmap(path):
        return CameraContent("COLMAP", read_colmap(path), _MM_PER_M, unit_known=False)
    if (path / "intri.yml").is_file():
        return read_opencv(path / "intri.yml")
    files = _camera_files(path)
    check_view_count(path, len(files))
    found = [_read_file(file, subject) for file in files]
    if len(found) == 1:
        return found[0]
    several = [file.name for file, each in zip(files, found, strict=True) if len(each.entries) > 1]
    if several:
        problem = f"holds several files of cameras: {', '.join(sorted(several)[:5])}"
        raise GhptDataError(path, "", problem, f"Name one: cameras={path / several[0]}")
    if len({(each.format, each.unit_mm) for each in found}) > 1:
        formats = ", ".join(sorted({each.format for each in found}))
        problem = f"holds cameras of several formats: {formats}"
        raise GhptDataError(path, "", problem, "Keep the cameras of one rig in a folder.")
    names = _file_names(files)
    entries = [
        replace(entry, name=name if entry.name == file.stem else entry.name, other_name=name)
        for file, name, each in zip(files, names, found, strict=True)
        for entry in each.entries
    ]
    return replace(found[0], entries=entries)


def _camera_files(folder: Path) -> list[Path]:
    """Return the files of a folder that may be cameras, or those in the folders in it.

    Raises GhptDataError, saying what else is there, where there are none.
    """
    for pattern in ("*", "*/*"):
        files = [file for file in sorted(folder.glob(pattern)) if _may_be_camera(file)]
        if files:
            return files
    there = sorted(entry.name for entry in folder.iterdir())
    listed = ", ".join(there[:5]) + (", ..." if len(there) > 5 else "")
    raise GhptDataError(
        folder, "", f"holds no file of cameras: {listed or 'it is empty'}", KNOWN_CAMERAS
    )


def _may_be_camera(file: Path) -> bool:
    visible = not file.name.startswith(".")
    return visible and file.suffix.lower() in _SUFFIXES and file.is_file()


def _file_names(files: list[Path]) -> list[str]:
    """Return what the cameras are called: as their files, or as the folders of these."""
    stems = [file.stem for file in files]
    return stems if len(set(stems)) == len(stems) else [file.parent.name for file in files]


def _camera_set(path: Path, content: CameraContent) -> CameraSet:
    """Check the cameras of a file. Raises GhptDataError."""
    entries = content.entries
    if not entries:
        raise GhptDataError(path, "", "holds 0 cameras", KNOWN_CAMERAS)
    check_view_count(path, len(entries))
    if len(entries) == 1 and path.is_file() and content.format in _ONE_EACH:
        hint = f"Name the folder of all: cameras={path.parent}"
        raise GhptDataError(path, "", "holds 1 camera", hint)
    names = tuple(entry.name for entry in entries)
    K = np.stack([_intrinsics(path, entry) for entry in entries])
    lenses = torch.stack([_lens(path, entry) for entry in entries])
    plain = not lenses[:, 5:].any()
    poses = [_pose(path, entry, content.unit_mm) for entry in entries]
    complete = [pose or (np.eye(3), np.zeros(3)) for pose in poses]
    R = np.stack([pose[0] for pose in complete])
    t = np.stack([pose[1] for pose in complete])
    cameras, distortion = check_cameras(path, names, K, R, t, lenses[:, : 5 if plain else None])
    posed = torch.tensor([pose is not None for pose in poses])
    calibrated = _tell_apart(R[posed.numpy()], t[posed.numpy()])
    sizes = [_size(path, entry) for entry in entries]
    unposed = [name for name, pose in zip(names, poses, strict=True) if pose is None]
    return CameraSet(
        path=str(path),
        format=content.format,
        names=names,
        other_names=tuple(entry.other_name for entry in entries),
        K=cameras.K,
        distortion=torch.from_numpy(distortion),
        size=None if None in sizes else torch.tensor(sizes, dtype=torch.int64),
        R=torch.where(posed[:, None, None], cameras.R, torch.nan) if calibrated else None,
        t=torch.where(posed[:, None], cameras.t, torch.nan) if calibrated else None,
        unposed=tuple(unposed),
        unit_mm=content.unit_mm,
        unit_known=content.unit_known,
        clock=_clock(path, entries),
    )


def _tell_apart(R: Float[np.ndarray, "P 3 3"], t: Float[np.ndarray, "P 3"]) -> bool:
    """Return whether there are several poses, not all the same.

    A file before extrinsic calibration has zeros for all.
    """
    return len(R) > 1 and bool((R[0] != R).any() or (t[0] != t).any())


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


def _lens(path: Path, entry: CameraEntry) -> Float[torch.Tensor, " 9"]:
    values = _numbers(path, entry.name, "distortion", entry.distortion, _LENSES)
    used = 4 if entry.fisheye else 8
    if values[used:].any():
        problem = f"has a coefficient after the first {used} that is not 0"
        hint = "Calibrate it with a lens of k1 k2 p1 p2 k3 k4 k5 k6, or as a fisheye of k1 to k4."
        raise GhptDataError(path, f"camera {entry.name}, distortion", problem, hint)
    kept = torch.from_numpy(np.resize(np.append(values[:used], np.zeros(8)), used))
    if entry.fisheye:
        return fisheye_lens(kept)
    return torch.nn.functional.pad(kept, (0, COEFFICIENTS - used))


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
    t = _numbers(path, entry.name, "translation", entry.t, (3,)) * mm_per_unit
    return (R.T, -R.T @ t) if entry.to_world else (R, t)


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
        *others, last = map(str, sizes)
        expected = f"{', '.join(others)} or {last}" if others else last
        problem = f"is not {expected} finite numbers"
        hint = "Check how the file was written."
        raise GhptDataError(path, f"camera {name}, {field}", problem, hint)
    return flat
