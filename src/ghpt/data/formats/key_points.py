"""People's own 2D key points, as a detector wrote them.

The format is recognised by its content, or named.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ghpt.data.formats.authors_npy import read_authors
from ghpt.data.formats.coco import read_coco
from ghpt.data.formats.mediapipe import is_caliscope, opening, read_caliscope
from ghpt.data.formats.mmpose import read_mmpose
from ghpt.data.formats.movement_files import (
    EXTENSIONS,
    read_deeplabcut,
    read_lightning_pose,
    read_sleap,
)
from ghpt.data.formats.openpose import read_openpose
from ghpt.data.formats.own_npz import read_own, write_key_points
from ghpt.data.formats.skeletons import find_skeleton, skeleton_of
from ghpt.data.formats.validate import frame_rate, open_input
from ghpt.data.people.detections import Detections
from ghpt.data.points import KeyPoints
from ghpt.errors import GhptDataError

__all__ = ["FORMATS", "Detections", "KeyPoints", "read_key_points", "write_key_points"]

_HINT = (
    "Known: a folder with OpenPose's JSON files in a folder for each camera; COCO results or "
    "MMPose's JSON, a file for each camera; caliscope's xy_*.csv; an npz file of ghpt; the "
    "authors' all_2d_preds.npy; DeepLabCut, SLEAP and LightningPose files (docs/calibration.md). "
    "Or name it: format=."
)


def read_key_points(
    path: str | Path,
    skeleton: str | None = None,
    rate_hz: int | float | None = None,
    format: str | None = None,
) -> Detections:
    """Return everybody in a folder or file of key points.

    ``skeleton`` and ``rate_hz`` say what the files do not, or overrule them; ``format`` is one of
    ``FORMATS``, and recognised by content if None.

    Raises GhptDataError for what is damaged, empty or not known, naming file, field and hint.
    """
    path = Path(path)
    rate = None if rate_hz is None else frame_rate(path, rate_hz)
    wanted = None if skeleton is None else find_skeleton(path, skeleton)
    if format is not None and format not in FORMATS:
        raise GhptDataError(
            path, "format", f"there is no format {format!r}", f"Choose from {', '.join(FORMATS)}."
        )
    people = FORMATS[format or _format_of(path)](path, skeleton)
    if wanted is None or wanted.key_points != people.joints:
        wanted = skeleton_of(path, people.joints)
    people = replace(people, own_skeleton=wanted)
    seen_by = set(people.view[people.points.valid.any(-1)].tolist())
    for view, name in enumerate(people.views):
        if view not in seen_by:
            raise GhptDataError(
                path, f"view {name}", "has no key point", "Detect this view again, or leave it out."
            )
    return people if rate_hz is None else replace(people, rate_hz=rate)


FORMATS: dict[str, Callable[[Path, str | None], Detections]] = {
    "openpose": read_openpose,
    "coco": read_coco,
    "mmpose": read_mmpose,
    "caliscope": lambda path, _: read_caliscope(path),
    "npz": read_own,
    "authors": read_authors,
    "deeplabcut": read_deeplabcut,
    "sleap": read_sleap,
    "lightningpose": read_lightning_pose,
}


def _format_of(path: Path) -> str:
    """Return the name of the format, by what a folder has in it or how a file begins."""
    if not path.is_dir():
        form = _format_of_file(path)
        if form in (None, "openpose"):
            raise GhptDataError(path, "", "is not a key-point format that is known", _HINT)
        return form
    if any(path.glob("all_2d_preds*.npy")):
        return "authors"
    inside = (
        file for file in sorted(path.iterdir()) if file.suffix.lower() in (".json", *EXTENSIONS)
    )
    first = next(inside, None)
    return "openpose" if first is None else _format_of_file(first) or "openpose"


def _format_of_file(path: Path) -> str | None:
    with open_input(path) as handle:
        start = handle.read(4096)
    for magic, form in _MAGIC.items():
        if start.startswith(magic):
            return form
    text = opening(start)
    if is_caliscope(text):
        return "caliscope"
    if text.startswith("scorer,"):
        return "deeplabcut"
    if text.startswith(("{", "[")):
        words = (('"instance', "mmpose"), ('"meta_info"', "mmpose"), ('"people"', "openpose"))
        return next((form for word, form in words if word in text), "coco")
    return None


_MAGIC = {b"PK\x03\x04": "npz", b"\x93NUMPY": "authors", b"\x89HDF": "sleap"}
