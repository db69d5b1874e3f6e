"""Our npz file of key points, where its arrays are stored without compression.

Such a file is read in parts, however long it is.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from collections.abc import Sequence as Items
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int

from ghpt.data.formats.names import Name
from ghpt.data.formats.own_npz import check_names
from ghpt.data.formats.skeletons import find_skeleton, recognise, skeleton_of
from ghpt.data.formats.stored_npz import Member, members_of, read_rows, text_table
from ghpt.data.formats.validate import check_view_count, finite_points, frame_rate
from ghpt.data.people.detections import joints_for
from ghpt.data.people.matching import match_views
from ghpt.data.people.persons import undistort_view
from ghpt.data.people.pixel_checks import check_image_sizes, check_pixels
from ghpt.data.people.sequence import Rows, Sequence
from ghpt.data.points import KeyPoints
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import CameraSet
from ghpt.skeleton import HUMAN36M, Skeleton

_CHECKED = 2000
"""Frames, evenly spread, by which the skeleton is recognised and the views are checked against
their cameras.
"""
_CHUNK = 4096
_FORMS = {
    "key_points": ("f", 4),
    "confidence": ("f", 3),
    "seen": ("b", 3),
    "frame": ("iu", 1),
    "rate_hz": ("fiu", 0),
}
"""The kind and the number of dimensions of each array."""


@dataclass(frozen=True)
class StoredFile:
    """An opened file; see ``ghpt.data.formats.own_npz`` for what it holds."""

    path: Path
    members: dict[str, Member]
    views: tuple[str, ...]
    skeleton: Skeleton
    frame: Int[np.ndarray, " T"]
    rate_hz: float | None
    least_confidence: float = 0.0
    """Below it a key point is missing."""

    def __len__(self) -> int:
        return len(self.frame)

    def spread(self) -> Rows:
        """Return the rows by which the file is checked."""
        count = min(_CHECKED, len(self))
        return np.unique(np.linspace(0, len(self) - 1, count).astype(np.int64))

    def read(self, rows: Rows) -> KeyPoints:
        """Return the key points [N V K] of some rows, which rise."""
        pixels = self._read("key_points", rows).astype(np.float64)
        valid = finite_points(pixels)
        if "seen" in self.members:
            valid &= self._read("seen", rows)
        confidence = np.ones(valid.shape)
        if "confidence" in self.members:
            confidence = self._read("confidence", rows).astype(np.float64)
        confidence = np.where(valid, np.nan_to_num(confidence).clip(0, 1), 0)
        points = KeyPoints(np.where(valid[..., None], pixels, 0), confidence, valid)
        return points.above(self.least_confidence)

    def _read(self, name: str, rows: Rows) -> np.ndarray:
        member = self.members[name]
        breaks = np.flatnonzero(np.diff(rows) != 1) + 1
        runs = np.split(rows, breaks)
        parts = [read_rows(self.path, member, int(run[0]), int(run[-1]) + 1) for run in runs]
        return np.concatenate(parts)


@dataclass(frozen=True)
class StoredKeyPoints:
    """The key points of a sequence in an opened file."""

    file: StoredFile
    views: tuple[int, ...]
    """The file's views that have a camera."""
    cameras: CameraSet

    def undistorted(self, rows: Rows) -> KeyPoints:
        points = self.file.read(rows)
        views = [
            undistort_view(points[:, view], self.cameras, camera)
            for camera, view in enumerate(self.views)
        ]
        return KeyPoints.stack(views).mask_invalid()

    def detected(self, rows: Rows) -> KeyPoints:
        return self.file.read(rows)[:, list(self.views)]


def open_stored(
    path: str | Path,
    skeleton: str | None,
    rate_hz: float | None,
    least_confidence: float = 0.0,
) -> StoredFile | None:
    """Open the file, or return None if it is not one that can be read in parts.

    `read_key_points` then reads it, or says what is wrong with it. Raises GhptDataError if what is
    in it does not fit together.
    """
    path = Path(path)
    try:
        members = members_of(path)
        views = text_table(path, members, "views")
        names = [name for name in ("joints", "skeleton") if name in members]
        texts = {name: text_table(path, members, name) for name in names}
    except (OSError, ValueError, zipfile.BadZipFile):
        return None
    if not _fits(members):
        return None
    frames, view_count, joint_count, _ = members["key_points"].shape
    check_view_count(path, view_count)
    frame = np.arange(frames)
    if "frame" in members:
        frame = read_rows(path, members["frame"], 0, frames).astype(np.int64)
    rate = _rate(path, members, rate_hz)
    file = StoredFile(path, members, views, HUMAN36M, frame, rate, least_confidence)
    joints: tuple[str, ...] = ()
    if skeleton is None and "skeleton" not in texts:
        joints = texts.get("joints", ())
    check_names(path, "views", views, view_count)
    if joints:
        check_names(path, "joints", joints, joint_count)
        found = skeleton_of(path, joints)
    else:
        written = next(iter(texts.get("skeleton", ())), None)
        name = skeleton or written or _recognise(file, joint_count)
        joints_for(path, name, joint_count)
        found = find_skeleton(path, name)
    if (np.diff(frame) <= 0).any():
        raise GhptDataError(path, "frame", "does not rise", "Number the frames in order.")
    file = replace(file, skeleton=found)
    _check_views(file)
    return file


def stored_sequence(
    file: StoredFile,
    cameras: CameraSet,
    match: Mapping[Name, Name] | None,
    views: Items[Name] | None,
    title: str,
) -> Sequence:
    """Return the sequence of an opened file.

    Raises GhptDataError as ``person_sequence`` does.
    """
    path = str(file.path)
    at, ordered = match_views(path, file.views, cameras, match, views)
    points = file.read(file.spread())[:, at]
    check_pixels(path, points, ordered)
    check_image_sizes(path, points, ordered)
    stored = StoredKeyPoints(file, tuple(at), ordered)
    return Sequence(title, path, ordered, file.frame, file.rate_hz, stored, file.skeleton)


def _fits(members: Mapping[str, Member]) -> bool:
    """Return whether the arrays have the form that is read in parts."""
    if "key_points" not in members:
        return False
    for name, (kinds, dimensions) in _FORMS.items():
        member = members.get(name)
        if member and (member.dtype.kind not in kinds or len(member.shape) != dimensions):
            return False
    frames, views, joints, coordinates = members["key_points"].shape
    joint_shape = (frames, views, joints)
    shapes = {"confidence": joint_shape, "seen": joint_shape, "frame": (frames,)}
    same = all(members[name].shape == shape for name, shape in shapes.items() if name in members)
    return coordinates == 2 and frames > 0 and same


def _rate(path: Path, members: Mapping[str, Member], rate_hz: float | None) -> float | None:
    if rate_hz is None and "rate_hz" in members:
        member = members["rate_hz"]
        rate_hz = float(np.fromfile(path, member.dtype, 1, offset=member.offset)[0])
    return None if rate_hz is None else frame_rate(path, rate_hz)


def _recognise(file: StoredFile, joints: int) -> str:
    points = file.read(file.spread())
    return recognise(
        file.path, points.pixels.reshape(-1, joints, 2), points.valid.reshape(-1, joints)
    )


def _check_views(file: StoredFile) -> None:
    """Raise GhptDataError for a view without a key point."""
    valid: Bool[np.ndarray, " V"] = np.zeros(len(file.views), bool)
    for start in range(0, len(file), _CHUNK):
        rows = np.arange(start, min(start + _CHUNK, len(file)))
        valid |= file.read(rows).valid.any((0, 2))
    for view in np.flatnonzero(~valid):
        hint = "Detect this view again, or leave it out."
        raise GhptDataError(file.path, f"view {file.views[view]}", "has no key point", hint)
