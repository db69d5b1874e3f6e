"""Human3.6M as the paper's authors prepare it: karfly's labels, and 2D predictions in chunks."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from ghpt.data.datasets.detections import uncrop, undistort_key_points
from ghpt.data.datasets.labels import LABELS_FILE, Labels, read_labels
from ghpt.data.formats.validate import check_cameras, check_names, read_npy
from ghpt.errors import GhptDataError, check
from ghpt.geometry.cameras import Cameras
from ghpt.observations import LabelledRecording

SUBJECTS = {"train": ("S1", "S5", "S6", "S7"), "validation": ("S8",), "test": ("S9", "S11")}
"""Split -> subjects (paper, section 4.1)."""
DAMAGED = frozenset({"S9/Greeting-2", "S9/SittingDown-2", "S9/Waiting-1"})
"""Takes whose ground truth is off."""

_RATE_HZ = 50.0
_BLOCK = 4096
"""Frames worked on at once."""
_SAME_MM = 1.0
_LAYOUT = (
    "S<k>/ must hold all_2d_preds<n>.npy, all_bboxes<n>.npy and all_3d_gt<n>.npy "
    "for n = 0, 1, 2, ..."
)


def human36m_files(root: Path, split: str) -> list[Path]:
    """Return the files that a split is made of. Raises GhptDataError if one is missing."""
    files = [_labels_file(root)]
    for subject in _subjects(split):
        for chunk in _chunk_files(root / subject):
            files += chunk.all
    return files


def human36m_recordings(
    root: Path,
    split: str,
    numbers: Sequence[int],
    damaged: bool,
) -> Iterator[LabelledRecording]:
    """Return the takes of a split in the views ``numbers`` of the labels' cameras.

    ``damaged`` keeps the takes whose ground truth is `DAMAGED`. A key point without a bounding box
    is not valid; the detector's confidence is not in the files and taken as 1. Where the chunks are
    not the labels' frames, takes cannot be told apart: a subject is then one recording of action
    ``unknown``, with a warning. Raises GhptDataError if a file is missing, damaged or not what it
    should be.
    """
    labels = read_labels(_labels_file(root))
    check_names(labels.path, numbers, range(len(labels.cameras)))
    for name in _subjects(split):
        subject = _open_subject(root, name, labels, list(numbers))
        for take in _takes(subject, labels, damaged):
            if damaged or take.name not in DAMAGED:
                yield _read_recording(subject, take)


@dataclass(frozen=True)
class _ChunkFiles:
    """The files of one chunk of a subject."""

    predictions: Path
    boxes: Path
    truth: Path

    @property
    def all(self) -> tuple[Path, Path, Path]:
        return self.predictions, self.boxes, self.truth


@dataclass(frozen=True)
class _Subject:
    """One subject's cameras and chunks, memory-mapped."""

    name: str
    index: int
    views: list[int]
    camera_names: tuple[str, ...]
    cameras: Cameras
    distortion: Float[np.ndarray, "V 5"]
    predictions: list[np.ndarray]
    """[T C 17 2], pixels of the crop."""
    boxes: list[np.ndarray]
    """[T C 2 2], two corners (x, y), pixels."""
    truth: list[np.ndarray]
    """[T 17 3], mm."""


@dataclass(frozen=True)
class _Take:
    """One take of a subject."""

    name: str
    action: str
    rows: Int[np.ndarray, " T"]
    """Of the subject's chunks, ascending."""
    frame: Int[np.ndarray, " T"]


def _subjects(split: str) -> tuple[str, ...]:
    check(split in SUBJECTS, "split", f"is {split!r}", f"Existing: {', '.join(SUBJECTS)}.")
    return SUBJECTS[split]


def _labels_file(root: Path) -> Path:
    for file in (root / LABELS_FILE, root / "extra" / LABELS_FILE):
        if file.is_file():
            return file
    problem = f"there is no {LABELS_FILE}, nor extra/{LABELS_FILE}"
    raise GhptDataError(root, "", problem, "Put karfly's file there.")


def _chunk_files(folder: Path) -> list[_ChunkFiles]:
    """Return the files of each chunk, in order."""
    names = [file.name for file in folder.iterdir()] if folder.is_dir() else []
    matches = [re.fullmatch(r"all_2d_preds(\d+)\.npy", name) for name in names]
    numbers = [int(match[1]) for match in matches if match]
    chunks = []
    for n in range(max(numbers, default=0) + 1):
        chunk = _ChunkFiles(
            predictions=folder / f"all_2d_preds{n}.npy",
            boxes=folder / f"all_bboxes{n}.npy",
            truth=folder / f"all_3d_gt{n}.npy",
        )
        chunks.append(chunk)
    for file in (file for chunk in chunks for file in chunk.all):
        if not file.is_file():
            raise GhptDataError(file, "", "there is no such file", _LAYOUT)
    return chunks


def _open_subject(root: Path, name: str, labels: Labels, views: list[int]) -> _Subject:
    if name not in labels.subjects:
        problem = f"there is no {name}"
        hint = "Get the labels of all seven subjects."
        raise GhptDataError(labels.path, "subject_names", problem, hint)
    index = labels.subjects.index(name)
    all_views = len(labels.cameras)
    camera_names = tuple(labels.cameras[v] for v in views)
    cameras, distortion = check_cameras(
        f"{labels.path} ({name})",
        camera_names,
        labels.K[index][views],
        labels.R[index][views],
        labels.t[index][views],
        labels.distortion[index][views],
    )
    predictions = []
    boxes = []
    truth = []
    for files in _chunk_files(root / name):
        chunk = read_npy(files.predictions, (None, all_views, 17, 2), "f")
        frames = len(chunk)
        predictions.append(chunk)
        boxes.append(read_npy(files.boxes, (frames, all_views, 2, 2), "fiu"))
        truth.append(read_npy(files.truth, (frames, 17, 3), "f"))
    return _Subject(
        name=name,
        index=index,
        views=views,
        camera_names=camera_names,
        cameras=cameras,
        distortion=distortion,
        predictions=predictions,
        boxes=boxes,
        truth=truth,
    )


def _takes(subject: _Subject, labels: Labels, damaged: bool) -> list[_Take]:
    """Return the takes of a subject, in the order of the labels' actions."""
    rows = np.flatnonzero(labels.subject == subject.index)
    length = sum(map(len, subject.truth))
    if len(rows) != length or not _truth_agrees(labels, rows, subject.truth):
        return [_unknown_take(subject, labels, damaged, length)]
    action = labels.action[rows]
    takes = []
    for index in np.unique(action):
        name = labels.actions[index]
        own = np.flatnonzero(action == index)
        frame = labels.frame[rows[own]]
        takes.append(_Take(f"{subject.name}/{name}", name.rsplit("-", 1)[0], own, frame))
    return takes


def _unknown_take(subject: _Subject, labels: Labels, damaged: bool, length: int) -> _Take:
    """Return all frames of a subject as one take. Raises GhptDataError if damaged takes must go."""
    problem = "the chunks' frames are not the labels'"
    has_damaged = any(take.startswith(f"{subject.name}/") for take in DAMAGED)
    if has_damaged and not damaged:
        problem = f"{problem}, so damaged takes cannot be left out"
        hint = "Predict all frames of the labels, or set damaged."
        raise GhptDataError(labels.path, subject.name, problem, hint)
    problem = f"{problem}, so this subject is one recording of unknown action"
    warnings.warn(f"{labels.path}: {subject.name}: {problem}", stacklevel=3)
    rows = np.arange(length)
    return _Take(f"{subject.name}/unknown", "unknown", rows, rows)


def _truth_agrees(labels: Labels, rows: Int[np.ndarray, " T"], truth: list[np.ndarray]) -> bool:
    """Return whether the chunks' poses are those of the labels."""
    start = 0
    for chunk in truth:
        own = labels.key_points[rows[start : start + len(chunk)]]
        if (np.abs(own - chunk) > _SAME_MM).any():
            return False
        start += len(chunk)
    return True


def _read_recording(subject: _Subject, take: _Take) -> LabelledRecording:
    frames = len(take.rows)
    views = len(subject.views)
    key_points = np.empty((frames, views, 17, 2), np.float32)
    valid = np.empty((frames, views, 17), np.bool_)
    truth = np.empty((frames, 17, 3), np.float32)
    for start in range(0, frames, _BLOCK):
        block = slice(start, start + _BLOCK)
        rows = take.rows[block]
        crop = _take_rows(subject.predictions, rows)[:, subject.views]
        boxes = _take_rows(subject.boxes, rows)[:, subject.views]
        pixels, has_box = uncrop(crop.astype(np.float64), boxes.astype(np.float64))
        truth[block] = _take_rows(subject.truth, rows)
        for view in range(views):
            key_points[block, view], valid[block, view] = undistort_key_points(
                pixels[:, view],
                has_box[:, view],
                subject.cameras.K[view].numpy(),
                subject.distortion[view],
            )
    truth_valid = np.asarray(np.isfinite(truth).all(-1))
    truth[~truth_valid] = 0
    return LabelledRecording(
        name=take.name,
        subject=subject.name,
        action=take.action,
        rate_hz=_RATE_HZ,
        camera_names=subject.camera_names,
        cameras=subject.cameras,
        key_points=key_points,
        confidence=np.ones(valid.shape, np.float32),
        valid=valid,
        truth=truth,
        truth_valid=truth_valid,
        frame=take.frame.astype(np.int64),
    )


def _take_rows(chunks: list[np.ndarray], rows: Int[np.ndarray, " T"]) -> np.ndarray:
    """Return ascending rows of the chunks' concatenation."""
    parts = []
    start = 0
    for chunk in chunks:
        end = start + len(chunk)
        own = rows[(rows >= start) & (rows < end)]
        parts.append(chunk[own - start])
        start = end
    return np.concatenate(parts)
