"""Cameras in JSON files: Panoptic's, Human3.6M's, and those of one camera each."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ghpt.data.formats.camera_entry import KNOWN_CAMERAS, CameraContent, CameraEntry
from ghpt.data.formats.camera_fields import camera_from_fields, cameras_by_name, is_camera
from ghpt.data.formats.names import Name, chosen_name
from ghpt.data.formats.validate import SMALL_JSON, check_view_count, read_json, read_name
from ghpt.errors import GhptDataError

_MM_PER_M = 1000.0
_MM_PER_CM = 10.0
_PANOPTIC = "distCoef"
"""The field by which Panoptic's cameras are told from others in a list."""


def read_camera_json(path: Path, subject: Name) -> CameraContent:
    """Return the cameras of a JSON file: those of one, of several by name, or of a list.

    Raises GhptDataError.
    """
    content = read_json(path, SMALL_JSON)
    if isinstance(content, list):
        content = {"cameras": content}
    if not isinstance(content, dict):
        raise GhptDataError(path, "", "is not an object with cameras", KNOWN_CAMERAS)
    if _is_human36m(content):
        return CameraContent("Human3.6M", _human36m(path, content, subject), 1.0)
    listed = content.get("cameras", content)
    named = _named_cameras(listed)
    if named:
        check_view_count(path, len(named))
        entries = [camera_from_fields(path, name, camera) for name, camera in named.items()]
        return CameraContent("JSON", entries, _MM_PER_M, unit_known=False)
    if is_camera(content):
        entries = [camera_from_fields(path, path.stem, content)]
        return CameraContent("JSON", entries, _MM_PER_M, unit_known=False)
    return CameraContent("Panoptic", _panoptic(path, content), _MM_PER_CM)


def _is_human36m(content: Mapping[str, Any]) -> bool:
    return isinstance(content.get("intrinsics"), dict) and not is_camera(content)


def _named_cameras(listed: object) -> dict[str, Any]:
    """Return cameras by name, or by their place in a list; none of a list of Panoptic's."""
    if isinstance(listed, list):
        if not all(map(is_camera, listed)) or any(_PANOPTIC in camera for camera in listed):
            return {}
        return {str(place): camera for place, camera in enumerate(listed)}
    return cameras_by_name(listed) if isinstance(listed, dict) else {}


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
        raise GhptDataError(path, "cameras", "is not a list of cameras", KNOWN_CAMERAS)
    check_view_count(path, len(cameras))
    entries = []
    for camera in cameras:
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
