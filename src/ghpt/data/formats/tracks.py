"""Recordings with a file for each view that holds people's tracks through all frames."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ghpt.data.formats.layout import arrange_recordings, find_files
from ghpt.data.formats.skeletons import canonical
from ghpt.data.formats.source import Source
from ghpt.data.formats.validate import finite_points
from ghpt.data.people.detections import (
    Detections,
    check_people,
    detections_in_view,
    merge_views,
)
from ghpt.errors import GhptDataError

_FARTHEST = 1e6
"""Pixels."""


@dataclass(frozen=True)
class Tracks:
    """T frames of P people of K joints in one view."""

    values: Float[np.ndarray, "T P K 3"]
    """x, y, confidence; NaN where there is nothing, a NaN confidence is 1."""
    names: tuple[str, ...]
    """Of the joints, as the file has them."""
    first_frame: int = 0


def read_tracks(
    source: Source, endings: Collection[str], read: Callable[[Path], Tracks]
) -> Detections:
    """Return everybody in the files of these endings, of which ``read`` gives the tracks.

    Raises GhptDataError where there is no such file, and for views with other joints than others.
    """
    root = source.path
    files = [file for file in find_files(root, endings) if file.suffix.lower() in endings]
    if not files:
        problem = f"holds no {' or '.join(endings)}"
        raise GhptDataError(root, "", problem, "Export such files, one for each camera.")
    names = [file.relative_to(root if root.is_dir() else root.parent) for file in files]
    named: dict[tuple[str, ...], Path] = {}
    found = []
    for view, index in arrange_recordings(root, names, source.session):
        detections = _detections(files[index], view, read(files[index]))
        named.setdefault(detections.joints, files[index])
        found.append(detections)
    if len(named) > 1:
        problem = "are named otherwise than in the files before"
        hint = "Track all views with one model."
        raise GhptDataError(list(named.values())[1], "keypoints", problem, hint)
    return merge_views(root, found, source.skeleton)


def _detections(file: Path, view: str, tracks: Tracks) -> Detections:
    pixels = tracks.values[..., :2]
    near = np.abs(np.nan_to_num(pixels)) < _FARTHEST
    valid = finite_points(pixels) & near.all(-1)
    # SLEAP's hand-made labels have no score
    sure = np.where(np.isfinite(tracks.values[..., 2]), tracks.values[..., 2], 1.0)
    values = np.concatenate([pixels, sure[..., None]], -1)
    values = np.where(valid[..., None], values, 0)
    frame, person = np.nonzero(valid.any(-1))
    counts = np.bincount(frame, minlength=1)
    check_people(file, "", int(counts.max()))
    numbers = np.arange(len(valid)) + tracks.first_frame
    joints = canonical(tracks.names)
    own = values[frame, person]
    return detections_in_view(file, view, numbers, numbers[frame], own, joints=joints)
