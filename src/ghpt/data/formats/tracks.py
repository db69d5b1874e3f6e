"""Recordings with a file for each view that holds people's tracks through all frames."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

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
_COORDINATES = ("x", "y", "likelihood")
_DENSEST = 1000
"""Places of people and joints for each column that is there."""


@dataclass(frozen=True)
class Tracks:
    """N detections of K joints in F frames of one view."""

    frames: Int[np.ndarray, " F"]
    """Numbers of all frames that were looked at."""
    frame: Int[np.ndarray, " N"]
    """Number of each detection's frame."""
    identity: Int[np.ndarray, " N"]
    """What its tracker calls each, -1 where none does."""
    values: Float[np.ndarray, "N K 3"]
    """x, y, confidence; NaN where there is nothing, a NaN confidence is 1."""
    names: tuple[str, ...]
    """Of the joints, as the file has them."""

    @classmethod
    def of_grid(
        cls,
        frames: Int[np.ndarray, " T"],
        values: Float[np.ndarray, "T P K 3"],
        names: tuple[str, ...],
    ) -> Tracks:
        """Return the tracks of P people, each with a place in every frame."""
        row, person = np.nonzero(np.isfinite(values[..., :2]).all(-1).any(-1))
        identity = person if values.shape[1] > 1 else np.full(len(row), -1)
        return cls(frames, frames[row], identity, values[row, person], names)


def grid_of_columns(
    columns: Sequence[tuple[str, ...]], values: Float[np.ndarray, "T C"]
) -> tuple[Float[np.ndarray, "T P K 3"], tuple[str, ...]]:
    """Return DeepLabCut's table, and its joints, for `Tracks.of_grid`.

    Its columns are named scorer, (individual,) joint, coordinate. Raises ValueError.
    """
    if not columns or min(map(len, columns)) < 3:
        raise ValueError("its columns are no joints")
    people = {key: index for index, key in enumerate(dict.fromkeys(c[:-2] for c in columns))}
    joints = {key: index for index, key in enumerate(dict.fromkeys(c[-2] for c in columns))}
    if len(people) * len(joints) > _DENSEST * len(columns):
        raise ValueError("its columns are no table of people and joints")
    found = np.full((len(values), len(people), len(joints), 3), np.nan)
    for column, own in zip(columns, values.T, strict=True):
        if column[-1] in _COORDINATES:
            place = people[column[:-2]], joints[column[-2]]
            found[:, *place, _COORDINATES.index(column[-1])] = own
    return found, tuple(joints)


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
    kept = np.flatnonzero(valid.any(-1))
    kept = kept[np.argsort(tracks.frame[kept], kind="stable")]
    frame = tracks.frame[kept]
    check_people(file, "", int(np.unique(frame, return_counts=True)[1].max(initial=0)))
    return detections_in_view(
        file,
        view,
        tracks.frames,
        frame,
        values[kept],
        identity=tracks.identity[kept],
        joints=canonical(tracks.names),
    )
