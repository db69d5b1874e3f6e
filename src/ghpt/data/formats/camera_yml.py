"""Cameras in the yml files of OpenCV and EasyMocap: intri.yml, with extri.yml beside it; and a file
for each camera, of OpenCV or ROS.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ghpt.data.formats.camera_entry import CameraContent, CameraEntry
from ghpt.data.formats.camera_fields import camera_from_lines, is_camera
from ghpt.data.formats.opencv_yml import Node, read_yml
from ghpt.data.formats.validate import check_view_count
from ghpt.errors import GhptDataError

_MM_PER_M = 1000.0


def read_opencv(path: Path) -> CameraContent:
    """Return the cameras of a yml file. Raises GhptDataError."""
    content = read_yml(path)
    if "names" not in content and is_camera(content):
        entries = [camera_from_lines(path, path.stem, content)]
        return CameraContent("YAML", entries, _MM_PER_M, unit_known=False)
    return CameraContent("OpenCV", _cameras(path, content), _MM_PER_M, unit_known=False)


def _cameras(path: Path, intrinsic: Mapping[str, Node | None]) -> list[CameraEntry]:
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
            distortion=_distortion(path, name, intrinsic),
            size=None if width is None or height is None else [width, height],
            R=vector if matrix is None else matrix,
            t=extrinsic.get(f"T_{name}"),
        )
        entries.append(entry)
    return entries


def _distortion(path: Path, name: str, intrinsic: Mapping[str, object]) -> object:
    distortion = intrinsic.get(f"dist_{name}", intrinsic.get(f"D_{name}"))
    if distortion is not None:
        return distortion
    if any(key.startswith(("dist_", "D_")) for key in intrinsic):
        problem = "is missing, and other cameras have it"
        hint = "Write zeros if this lens does not distort."
        raise GhptDataError(path, f"dist_{name}", problem, hint)
    return [0.0] * 5
