"""The real camera rigs that the package carries, and the paper's five arrangements of them."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

import torch
from torch import Tensor

from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import Cameras, CameraSet

ARRANGEMENTS: dict[str, tuple[int, ...]] = {
    "cmu1": (1, 2, 3, 4, 6, 7, 10),
    "cmu2": (12, 16, 18, 19, 22, 23, 30),
    "cmu3": (10, 12, 16, 18),
    "cmu4": (6, 7, 10, 12, 16, 18, 19, 22, 23, 30),
    "h36m": (0, 1, 2, 3),
}
"""Camera numbers of the paper's section 4.1: Panoptic's HD cameras, and Human3.6M's four in order
of name.
"""


@dataclass(frozen=True)
class _Camera:
    """One camera as the package's JSON files have it, in the file's unit of length."""

    K: list[list[int | float]]
    distortion: list[int | float]
    size: list[int]
    R: list[list[int | float]]
    t: list[int | float]


def human36m_rig(subject: str) -> CameraSet:
    """Return Human3.6M's four cameras as they stood for a subject, ``S1`` to ``S11``.

    They are in mm, world z up. Raises GhptDataError for an unknown subject.
    """
    cameras = _human36m_cameras()
    if subject not in cameras:
        known = sorted(cameras, key=lambda name: int(name.removeprefix("S")))
        problem = f"no subject {subject!r}"
        raise GhptDataError("Human3.6M", "subject", problem, f"There are {', '.join(known)}.")
    return _rig(cameras[subject], mm_per_unit=1.0)


def panoptic_rig(numbers: Sequence[int]) -> CameraSet:
    """Return HD cameras of CMU Panoptic Studio by number (sequence 160906_band1).

    They are in mm, world y down. Raises GhptDataError for an unknown number, a camera listed twice,
    or fewer than two cameras.
    """
    cameras = _panoptic_cameras()
    unknown = [number for number in numbers if number not in cameras]
    if unknown:
        hint = f"HD cameras are 0 to {len(cameras) - 1}."
        raise GhptDataError("Panoptic", "cameras", f"no HD camera {unknown[0]}", hint)
    repeated = [number for number, count in Counter(numbers).items() if count > 1]
    if repeated:
        problem = f"camera {repeated[0]} is listed twice"
        raise GhptDataError("Panoptic", "cameras", problem, "List each camera once.")
    if len(numbers) < 2:
        problem = f"{len(numbers)} listed: {list(numbers)}"
        raise GhptDataError("Panoptic", "cameras", problem, "Triangulation needs at least two.")
    return _rig({f"00_{number:02d}": cameras[number] for number in numbers}, mm_per_unit=10.0)


@cache
def _human36m_cameras() -> dict[str, dict[str, _Camera]]:
    """Return the cameras by subject and name."""
    table = _load("human36m_cameras.json")
    intrinsics: dict[str, dict[str, Any]] = table["intrinsics"]
    extrinsics: dict[str, dict[str, Any]] = table["extrinsics"]
    cameras: dict[str, dict[str, _Camera]] = {}
    for key, pose in extrinsics.items():
        subject, name = key.split("/")
        cameras.setdefault(subject, {})[name] = _Camera(**intrinsics[name], **pose)
    # in the order of the intrinsics, which is that of the names
    return {subject: {n: views[n] for n in intrinsics} for subject, views in cameras.items()}


@cache
def _panoptic_cameras() -> dict[int, _Camera]:
    """Return the HD cameras by number."""
    table = _load("panoptic_hd_cameras.json")
    entries: dict[str, dict[str, Any]] = table["cameras"]
    return {int(number): _Camera(**entry) for number, entry in entries.items()}


def _load(name: str) -> dict[str, Any]:
    file = resources.files("ghpt.data.synthetic") / name
    return json.loads(file.read_text(encoding="utf-8"))


def _rig(views: Mapping[str, _Camera], mm_per_unit: float) -> CameraSet:
    K = _stack([view.K for view in views.values()])
    R = _stack([view.R for view in views.values()])
    t = _stack([view.t for view in views.values()])
    distortion = _stack([view.distortion for view in views.values()])
    size = torch.tensor([view.size for view in views.values()])
    cameras = Cameras(K, R, t * mm_per_unit)
    return CameraSet.from_cameras(tuple(views), cameras, distortion, size)


def _stack(numbers: Sequence[Sequence[Any]]) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64)
