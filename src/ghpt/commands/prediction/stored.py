"""Our npz file of key points, where its arrays are stored without compression: read in parts,
however long it is.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int

from ghpt.commands.prediction.frames import Detected, Frames, Seen, calibrated
from ghpt.data.datasets.detections import undistort_key_points
from ghpt.data.formats.names import Name
from ghpt.data.formats.skeletons import joints17, recognise
from ghpt.data.formats.stored_npz import Member, members_of, read_rows, text_table
from ghpt.data.formats.validate import check_view_count, frame_rate
from ghpt.data.people.people import KeyPoints, joints_for
from ghpt.data.people.views import matched, undistort_and_match
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import CameraSet

_CHECKED = 2000
"""Frames, evenly spread, by which the skeleton is recognised and the views are checked against
their cameras.
"""
_PART = 4096
_FORMS = {
    "key_points": ("f", 4),
    "confidence": ("f", 3),
    "seen": ("b", 3),
    "frame": ("iu", 1),
    "rate_hz": ("fiu", 0),
}


@dataclass(frozen=True)
class StoredKeyPoints:
    """An opened file; see ``ghpt.data.formats.own_npz`` for what it holds."""

    path: Path
    members: dict[str, Member]
    views: tuple[str, ...]
    joints: tuple[str, ...]
    frame: Int[np.ndarray, " T"]
    rate_hz: float | None

    def part(self, rows: Int[np.ndarray, " N"]) -> KeyPoints:
        """Some rows, which rise."""
        values = self._read("key_points", rows).astype(np.float64)
        valid = np.isfinite(values).all(-1)
        if "seen" in self.members:
            valid &= self._read("seen", rows)
        sure = (
            self._read("confidence", rows).astype(np.float64)
            if "confidence" in self.members
            else np.ones(valid.shape)
        )
        sure = np.where(valid, np.nan_to_num(sure).clip(0, 1), 0)
        values = np.where(valid[..., None], values, 0)
        return KeyPoints(
            str(self.path),
            self.views,
            self.joints,
            self.frame[rows],
            values,
            sure,
            valid,
            self.rate_hz,
            (0,) * len(self.views),
        )

    def _read(self, name: str, rows: Int[np.ndarray, " N"]) -> np.ndarray:
        member = self.members[name]
        broken = np.flatnonzero(np.diff(rows) != 1) + 1
        found = [
            read_rows(self.path, member, int(run[0]), int(run[-1]) + 1)
            for run in np.split(rows, broken)
        ]
        return np.concatenate(found)


def open_stored(
    path: str | Path, skeleton: str | None, rate_hz: float | None
) -> StoredKeyPoints | None:
    """The file, or None if it is not one that can be read in parts: `read_key_points` then reads
    it, or says what is wrong with it. Raises GhptDataError if what is in it does not fit together.
    """
    path = Path(path)
    try:
        members = members_of(path)
        views = text_table(path, members, "views")
        texts = {
            name: text_table(path, members, name)
            for name in ("joints", "skeleton")
            if name in members
        }
    except (OSError, ValueError, zipfile.BadZipFile):
        return None
    if "key_points" not in members or any(
        members[name].dtype.kind not in kinds or len(members[name].shape) != dims
        for name, (kinds, dims) in _FORMS.items()
        if name in members
    ):
        return None
    count, *shape, two = members["key_points"].shape
    lengths = {"confidence": (count, *shape), "seen": (count, *shape), "frame": (count,)}
    if (
        two != 2
        or not count
        or any(members[n].shape != s for n, s in lengths.items() if n in members)
    ):
        return None
    check_view_count(path, shape[0])
    frame = (
        read_rows(path, members["frame"], 0, count).astype(np.int64)
        if "frame" in members
        else np.arange(count)
    )
    if rate_hz is None and "rate_hz" in members:
        member = members["rate_hz"]
        rate_hz = float(np.fromfile(path, member.dtype, 1, offset=member.offset)[0])
    rate_hz = None if rate_hz is None else frame_rate(path, rate_hz)
    stored = StoredKeyPoints(path, members, views, (), frame, rate_hz)
    spread = stored.part(
        np.unique(np.linspace(0, count - 1, min(_CHECKED, count)).astype(np.int64))
    )
    joints = texts.get("joints", ()) if skeleton is None and "skeleton" not in texts else ()
    if not joints:
        flat = spread.key_points.reshape(-1, shape[1], 2), spread.valid.reshape(-1, shape[1])
        name = skeleton or next(iter(texts.get("skeleton", ())), None) or recognise(path, *flat)
        joints = joints_for(path, name, shape[1])
    _check_names(path, {"views": (views, shape[0]), "joints": (joints, shape[1])}, frame)
    stored = StoredKeyPoints(path, members, views, joints, frame, rate_hz)
    valid = np.zeros(shape[0], bool)
    for start in range(0, count, _PART):
        valid |= stored.part(np.arange(start, min(start + _PART, count))).valid.any((0, 2))
    for view in np.flatnonzero(~valid):
        raise GhptDataError(
            path,
            f"view {views[view]}",
            "has no key point",
            "Detect this view again, or leave it out.",
        )
    return stored


def frames_of_stored(
    stored: StoredKeyPoints,
    cameras: CameraSet,
    match: Mapping[Name, Name] | None,
    views: Sequence[Name] | None,
    title: str,
) -> Frames:
    """Raises GhptDataError as ``undistort_and_match`` does, and as ``frames_of_views``."""
    path = str(stored.path)
    pairs = matched(path, stored.views, cameras, match or {}, views)
    at = [view for view, _ in pairs]
    ordered = cameras.select([camera for _, camera in pairs])
    rig = calibrated(path, ordered)
    count = len(stored.frame)
    spread = np.unique(np.linspace(0, count - 1, min(_CHECKED, count)).astype(np.int64))
    undistort_and_match(stored.part(spread), cameras, match, views)

    def read(rows: Int[np.ndarray, " N"]) -> Seen:
        part = stored.part(rows)
        pixels = np.zeros((*part.valid[:, at].shape, 2), np.float32)
        valid = part.valid[:, at].copy()
        for view, of in enumerate(at):
            K = ordered.K[view].numpy()
            lens = ordered.distortion[view].numpy()
            pixels[:, view], valid[:, view] = undistort_key_points(
                part.key_points[:, of], valid[:, view], K, lens
            )
        return joints17(path, part.joints, pixels, part.confidence[:, at], valid)

    def detected(rows: Int[np.ndarray, " N"]) -> Seen:
        part = stored.part(rows)
        return joints17(
            path, part.joints, part.key_points[:, at], part.confidence[:, at], part.valid[:, at]
        )

    frame = stored.frame
    rate = stored.rate_hz
    return Frames(title, path, ordered.names, rig, frame, rate, read, Detected(ordered, detected))


def _check_names(
    path: Path, names: Mapping[str, tuple[tuple[str, ...], int]], frame: Int[np.ndarray, " T"]
) -> None:
    for field, (found, expected) in names.items():
        if len(found) != expected or len(set(found)) != len(found):
            problem = f"names {len(found)} for {expected} of key_points, or one twice"
            raise GhptDataError(path, field, problem, "Give each a name of its own.")
    if (np.diff(frame) <= 0).any():
        raise GhptDataError(path, "frame", "does not rise", "Number the frames in order.")
