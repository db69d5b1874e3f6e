"""Calibrated cameras in the formats that others read: Pose2Sim and aniposelib TOML, OpenCV /
EasyMocap yml; metres.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from ghpt.clock import Clock
from ghpt.data.formats.opencv_yml import read_yml
from ghpt.errors import GhptDataError
from ghpt.files import atomic_write
from ghpt.geometry.cameras import CameraSet
from ghpt.geometry.lens import is_fisheye, pad_lens
from ghpt.geometry.rotations import matrix_to_vector

_MM_PER_M = 1000.0
Metadata = Mapping[str, str | float | bool]


def write_pose2sim(path: str | Path, rig: CameraSet, metadata: Metadata) -> None:
    """A TOML file as Pose2Sim's calibration leaves it: a table for each camera, rotation vectors.

    Its lens model is OpenCV's, so what it has beyond the four coefficients that Pose2Sim writes is
    written after these. A fisheye's four are said to be its.
    """
    keys = [
        name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else json.dumps(name, ensure_ascii=False)
        for name in rig.names
    ]
    _write_toml(path, rig, keys, 4, metadata)


def write_aniposelib(path: str | Path, rig: CameraSet, metadata: Metadata) -> None:
    """A TOML file that aniposelib's ``CameraGroup.load`` reads.

    It takes the tables in the order of their keys as texts, so these have leading zeros: cam_02
    before cam_10.
    """
    digits = len(str(len(rig) - 1))
    keys = [f"cam_{i:0{digits}d}" for i in range(len(rig))]
    _write_toml(path, rig, keys, 5, metadata)


def write_opencv(folder: str | Path, rig: CameraSet) -> None:
    """``intri.yml`` and ``extri.yml`` as EasyMocap's ``read_camera`` and OpenCV's ``FileStorage``
    read them.

    FileStorage knows letters, digits, _ and - in a key; another character of a camera's name
    becomes _. Raises GhptDataError if two names are then the same, and for a fisheye, of which the
    format knows nothing.
    """
    names = [re.sub(r"[^A-Za-z0-9_-]", "_", name) for name in rig.names]
    if len(set(names)) != len(names):
        raise GhptDataError(
            Path(folder) / "intri.yml",
            "names",
            f"are the same in yml: {', '.join(rig.names)}",
            "Name the cameras by letters, digits, _ and -.",
        )
    if is_fisheye(rig.distortion).any():
        problem = "have a fisheye, which yml cannot say"
        raise GhptDataError(Path(folder) / "intri.yml", "dist", problem, "Write TOML.")
    vectors = matrix_to_vector(rig.cameras.R)
    lenses = _lenses(rig, 5)
    listed = ["names:", *(f'  - "{name}"' for name in names)]
    intrinsic = list(listed)
    extrinsic = list(listed)
    for i, name in enumerate(names):
        intrinsic += [
            *_matrix(f"K_{name}", rig.cameras.K[i]),
            *_matrix(f"dist_{name}", torch.tensor(lenses[i], dtype=torch.float64)[None]),
        ]
        if rig.size is not None:
            width, height = rig.size[i].tolist()
            intrinsic += [f"H_{name}: {height}", f"W_{name}: {width}"]
        extrinsic += [
            *_matrix(f"R_{name}", vectors[i][:, None]),
            *_matrix(f"Rot_{name}", rig.cameras.R[i]),
            *_matrix(f"T_{name}", rig.cameras.t[i][:, None] / _MM_PER_M),
        ]
    for file, lines in (("intri.yml", intrinsic), ("extri.yml", extrinsic)):
        with atomic_write(Path(folder) / file, "w", verify=read_yml) as handle:
            handle.write("\n".join(["%YAML:1.0", "---", *lines, ""]))


def _write_toml(
    path: str | Path,
    rig: CameraSet,
    keys: Sequence[str],
    least: int,
    metadata: Metadata,
) -> None:
    lenses = _lenses(rig, least)
    fisheyes = is_fisheye(rig.distortion).tolist()
    vectors = matrix_to_vector(rig.cameras.R).tolist()
    metres = (rig.cameras.t / _MM_PER_M).tolist()
    lines = []
    for i, (key, name) in enumerate(zip(keys, rig.names, strict=True)):
        lines += [
            f"[{key}]",
            f"name = {json.dumps(name, ensure_ascii=False)}",
            f"size = {[float(x) for x in rig.image_size[i].tolist()]}",
            f"matrix = {rig.cameras.K[i].tolist()}",
            f"distortions = {lenses[i]}",
            f"rotation = {vectors[i]}",
            f"translation = {metres[i]}",
            f"fisheye = {json.dumps(fisheyes[i])}",
            *_time(rig.clock, i),
            "",
        ]
    values = {key: json.dumps(value, ensure_ascii=False) for key, value in metadata.items()}
    lines += ["[metadata]", *(f"{key} = {value}" for key, value in values.items()), ""]
    with atomic_write(
        path, "w", verify=lambda file: tomllib.loads(file.read_text(encoding="utf-8"))
    ) as handle:
        handle.write("\n".join(lines))


def _lenses(rig: CameraSet, least: int) -> list[list[float]]:
    """Return each lens's coefficients: four of a fisheye, else ``least``, 5 or 8, as it needs."""
    found = []
    for lens in pad_lens(rig.distortion).tolist():
        *brown, fisheye = lens
        count = next(n for n in (least, 5, 8) if not any(brown[n:]))
        found.append(brown[: 4 if fisheye else count])
    return found


def _time(clock: Clock | None, view: int) -> list[str]:
    if clock is None or clock.is_synchronised:
        return []
    return [f"time = {{ rate = {clock.rate[view]!r}, shift = {clock.shift[view]!r} }}"]


def _matrix(key: str, values: Float[Tensor, "rows cols"]) -> list[str]:
    rows, cols = values.shape
    numbers = ", ".join(map(repr, values.flatten().tolist()))
    return [
        f"{key}: !!opencv-matrix",
        f"  rows: {rows}",
        f"  cols: {cols}",
        "  dt: d",
        f"  data: [{numbers}]",
    ]
