"""Cameras in the TOML files of Pose2Sim, aniposelib, caliscope and freemocap."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ghpt.data.formats.camera_entry import KNOWN_CAMERAS, CameraContent, CameraEntry
from ghpt.data.formats.camera_fields import camera_from_lines, is_camera
from ghpt.data.formats.validate import MOST_VIEWS, open_input, read_flag, read_name
from ghpt.errors import GhptDataError

_MM_PER_M = 1000.0
_LARGEST = 1 << 19
_DEEPEST = 100
"""Bytes of a TOML file; parts of a key in it, which cost their square to read."""
_MOST_TABLES = 10 * MOST_VIEWS
"""In a TOML file, with the rows of matrices that begin a line."""
_OTHER = "TOML"
"""What cameras with other fields than the tools' are called."""
_UNKNOWN_UNIT = ("aniposelib", _OTHER)
_FIELDS = ("matrix", "distortions", "rotation", "translation")


def read_toml(path: Path) -> CameraContent:
    """Return the cameras of a TOML file. Raises GhptDataError."""
    form, entries = _cameras(path)
    return CameraContent(form, entries, _MM_PER_M, unit_known=form not in _UNKNOWN_UNIT)


def _cameras(path: Path) -> tuple[str, list[CameraEntry]]:
    content = _parse(path)
    nested = content.get("cameras")
    numbered = isinstance(nested, dict)
    tables = nested if isinstance(nested, dict) else content
    entries = []
    others = []
    for key, table in tables.items():
        if not isinstance(table, dict) or not any(field in table for field in _FIELDS):
            if is_camera(table):
                others.append(camera_from_lines(path, key, table))
            continue
        if not read_flag(path, f"{key}.ignore", table.get("ignore", False)):
            entries.append(_camera(path, key, table, numbered))
    if others and not entries:
        return _OTHER, others
    if numbered:
        return "caliscope", entries
    fisheye = any("fisheye" in table for table in tables.values() if isinstance(table, dict))
    return "Pose2Sim" if fisheye else "aniposelib", entries


def _parse(path: Path) -> dict[str, Any]:
    with open_input(path) as handle:
        data = handle.read(_LARGEST + 1)
    if len(data) > _LARGEST:
        problem = f"has more than {_LARGEST >> 10} KiB"
        raise GhptDataError(path, "", problem, "Check that this is the right file.")
    if data.count(b"\n[") > _MOST_TABLES:
        raise GhptDataError(path, "", f"has more than {_MOST_TABLES} tables", KNOWN_CAMERAS)
    parts = re.split(rb"[=,\n]", data)
    if any(part.count(b".") > _DEEPEST for part in parts):
        raise GhptDataError(path, "", f"has a key of more than {_DEEPEST} parts", KNOWN_CAMERAS)
    try:
        return tomllib.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise GhptDataError(
            path, "", f"is no camera file: not TOML either ({error})", KNOWN_CAMERAS
        ) from error


def _camera(path: Path, key: str, table: Mapping[str, Any], numbered: bool) -> CameraEntry:
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
        fisheye=read_flag(path, f"{key}.fisheye", table.get("fisheye", False)),
    )
