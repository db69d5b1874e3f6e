"""The real camera rigs whose numbers the package carries, and the paper's five arrangements of
them.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
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


def human36m_rig(subject: str) -> CameraSet:
    """Human3.6M's four cameras as they stood for a subject, ``S1`` to ``S11``; mm, world z up."""
    table = _load("human36m_cameras.json")
    names = tuple(table["intrinsics"])
    if f"{subject}/{names[0]}" not in table["extrinsics"]:
        known = sorted(
            {key.split("/")[0] for key in table["extrinsics"]}, key=lambda name: int(name[1:])
        )
        raise GhptDataError(
            "Human3.6M", "subject", f"no subject {subject!r}", f"There are {', '.join(known)}."
        )
    return _rig(
        names,
        [table["intrinsics"][name] | table["extrinsics"][f"{subject}/{name}"] for name in names],
        mm_per_unit=1.0,
    )


def panoptic_rig(numbers: Sequence[int]) -> CameraSet:
    """HD cameras of CMU Panoptic Studio by number (sequence 160906_band1); mm, world y down.

    Raises GhptDataError for an unknown number, a camera listed twice, or fewer than two cameras.
    """
    table = _load("panoptic_hd_cameras.json")["cameras"]
    unknown = [number for number in numbers if str(number) not in table]
    if unknown:
        raise GhptDataError(
            "Panoptic",
            "cameras",
            f"no HD camera {unknown[0]}",
            f"HD cameras are 0 to {len(table) - 1}.",
        )
    twice = [number for number, count in Counter(numbers).items() if count > 1]
    if twice:
        raise GhptDataError(
            "Panoptic", "cameras", f"camera {twice[0]} is listed twice", "List each camera once."
        )
    if len(numbers) < 2:
        raise GhptDataError(
            "Panoptic",
            "cameras",
            f"{len(numbers)} listed: {list(numbers)}",
            "Triangulation needs at least two.",
        )
    return _rig(
        tuple(f"00_{number:02d}" for number in numbers),
        [table[str(n)] for n in numbers],
        mm_per_unit=10.0,
    )


@cache
def _load(name: str) -> dict[str, Any]:
    return json.loads(
        resources.files("ghpt.data.synthetic").joinpath(name).read_text(encoding="utf-8")
    )


def _rig(names: tuple[str, ...], entries: list[dict[str, Any]], mm_per_unit: float) -> CameraSet:
    def stack(field: str) -> Tensor:
        return torch.tensor([entry[field] for entry in entries], dtype=torch.float64)

    cameras = Cameras(stack("K"), stack("R"), stack("t") * mm_per_unit)
    size = stack("size").to(torch.int64)
    return CameraSet.from_cameras(names, cameras, stack("distortion"), size)
