"""People's own 2D key points, as a detector wrote them.

The format is recognised by its content, or named.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ghpt.config import suggest
from ghpt.data.formats.authors_npy import is_authors_file, read_authors
from ghpt.data.formats.caliscope import is_caliscope, read_caliscope
from ghpt.data.formats.csv_tracks import (
    is_deeplabcut,
    is_sleap_analysis,
    read_deeplabcut_csv,
    read_sleap_csv,
)
from ghpt.data.formats.freemocap import is_freemocap_file, read_freemocap
from ghpt.data.formats.hdf5_files import ENDINGS as HDF5_ENDINGS
from ghpt.data.formats.hdf5_files import read_hdf5
from ghpt.data.formats.json_content import looks_like_people
from ghpt.data.formats.json_people import read_json_people
from ghpt.data.formats.layout import find_files
from ghpt.data.formats.names import Name
from ghpt.data.formats.own_npz import read_own, write_key_points
from ghpt.data.formats.skeletons import find_skeleton, skeleton_of
from ghpt.data.formats.source import Source
from ghpt.data.formats.validate import frame_rate, open_input, opening
from ghpt.data.formats.yolo import looks_like_yolo, read_yolo
from ghpt.data.people.detections import Detections
from ghpt.data.points import KeyPoints
from ghpt.errors import GhptDataError

__all__ = [
    "FORMATS",
    "Detections",
    "KeyPoints",
    "format_of",
    "read_key_points",
    "write_key_points",
]

_HINT = (
    "Known: JSON files of OpenPose, AlphaPose, MMPose, rtmlib, EasyMocap and COCO results; "
    "Ultralytics' labels; caliscope's xy_*.csv; DeepLabCut, anipose, SLEAP and LightningPose "
    "files; the authors' all_2d_preds.npy; an npz file of ghpt (docs/calibration.md). Or name it: "
    "format=."
)
_ENDINGS = (".json", ".csv", *HDF5_ENDINGS, ".npy", ".npz", ".txt")
_LOOKED_AT = 20
"""Files of a folder that are opened to recognise the format."""


def read_key_points(
    path: str | Path,
    skeleton: str | None = None,
    rate_hz: int | float | None = None,
    format: str | None = None,
    session: Name = None,
    least_confidence: float = 0.0,
) -> Detections:
    """Return everybody in a folder or file of key points.

    ``skeleton`` and ``rate_hz`` say what the files do not, or overrule them; ``format`` is one of
    ``FORMATS``, and recognised by content if None. ``session`` chooses one of several recordings
    in a folder. A key point whose confidence is below ``least_confidence`` is missing.

    Raises GhptDataError for what is damaged, empty or not known, naming file, field and hint.
    """
    path = Path(path)
    rate = None if rate_hz is None else frame_rate(path, rate_hz)
    wanted = None if skeleton is None else find_skeleton(path, skeleton)
    if format is not None and format not in FORMATS:
        problem = f"there is no format {format!r}"
        raise GhptDataError(path, "format", problem, suggest(format, FORMATS))
    source = Source(path, skeleton, session, format)
    form = format or format_of(path)
    if session is not None and form in _ONE_RECORDING:
        problem = "files of this format hold one recording"
        raise GhptDataError(path, "session", problem, "Leave session= out.")
    people = read_json_people(source) if form == "json" else FORMATS[form](source)
    if wanted is None or wanted.key_points != people.joints:
        wanted = skeleton_of(path, people.joints)
    people = replace(people, own_skeleton=wanted)
    people = people.above(least_confidence)
    seen_by = set(people.view[people.points.valid.any(-1)].tolist())
    for view, name in enumerate(people.views):
        if view not in seen_by:
            problem = "has no key point"
            if least_confidence > 0:
                problem += f" with a confidence of at least {least_confidence:g}"
            hint = "Detect this view again, or leave it out."
            raise GhptDataError(path, f"view {name}", problem, hint)
    return people if rate_hz is None else replace(people, rate_hz=rate)


FORMATS: dict[str, Callable[[Source], Detections]] = {
    "openpose": read_json_people,
    "alphapose": read_json_people,
    "coco": read_json_people,
    "mmpose": read_json_people,
    "rtmlib": read_json_people,
    "easymocap": read_json_people,
    "yolo": read_yolo,
    "caliscope": read_caliscope,
    "freemocap": read_freemocap,
    "npz": lambda source: read_own(source.path, source.skeleton),
    "authors": lambda source: read_authors(source.path, source.skeleton),
    "deeplabcut": lambda source: _of_csv_or_hdf5(source, read_deeplabcut_csv),
    "anipose": read_hdf5,
    "sleap": lambda source: _of_csv_or_hdf5(source, read_sleap_csv),
    "lightningpose": read_deeplabcut_csv,
}
_ONE_RECORDING = ("caliscope", "freemocap", "npz", "authors")


def _of_csv_or_hdf5(source: Source, read_csv: Callable[[Source], Detections]) -> Detections:
    """Return what a tool's CSV files hold, or its HDF5 where it exported nothing else."""
    return read_csv(source) if find_files(source.path, (".csv",)) else read_hdf5(source)


def format_of(path: Path) -> str:
    """Return the name of the format, by how the files of a folder, or a file, begin.

    It is ``json`` for those that are told apart by their structure. Raises GhptDataError for none.
    """
    files = find_files(path, _ENDINGS)
    if path.is_dir() and any(is_authors_file(file) for file in files):
        return "authors"
    # the first files of each ending: others may lie beside the key points
    looked_at = [
        file
        for ending in _ENDINGS
        for file in [file for file in files if file.suffix.lower() == ending][:_LOOKED_AT]
    ]
    for file in looked_at if path.is_dir() else files:
        form = _format_of_file(file)
        if form is not None:
            return form
    if any(file.suffix.lower() == ".json" for file in files):
        return "json"
    raise GhptDataError(path, "", "is not a key-point format that is known", _HINT)


def _format_of_file(path: Path) -> str | None:
    with open_input(path) as handle:
        start = handle.read(4096)
    if is_freemocap_file(path):
        return "freemocap"
    for magic, form in _MAGIC.items():
        if start.startswith(magic):
            return form
    text = opening(start)
    if is_caliscope(text):
        return "caliscope"
    if is_deeplabcut(text):
        return "deeplabcut"
    if is_sleap_analysis(text):
        return "sleap"
    if looks_like_people(text):
        return "json"
    return "yolo" if looks_like_yolo(text) else None


_MAGIC = {b"PK\x03\x04": "npz", b"\x93NUMPY": "authors", b"\x89HDF": "anipose"}
