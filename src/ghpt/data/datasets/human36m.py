"""Human3.6M as the paper's authors prepare it: karfly's labels and 2D predictions in chunks per
subject.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from ghpt.data.datasets.detections import in_image, undistorted
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
_LAYOUT = "S<k>/ must hold all_2d_preds<n>.npy, all_bboxes<n>.npy and all_3d_gt<n>.npy for n = 0, 1, 2, ..."


def human36m_files(root: Path, split: str) -> list[Path]:
    """The files that a split is made of. Raises GhptDataError if one is missing."""
    return [
        _labels_file(root),
        *(f for s in _subjects(split) for chunk in _chunks(root / s) for f in chunk),
    ]


def human36m_recordings(
    root: Path, split: str, numbers: Sequence[int], damaged: bool
) -> Iterator[LabelledRecording]:
    """The takes of a split (train, validation, test) in the views ``numbers`` of the labels'
    cameras.

    ``damaged`` keeps the takes whose ground truth is `DAMAGED`. A view without a bounding box is
    not seen; the detector's confidence is not in the files and taken as 1. Where the chunks are not
    the labels' frames, takes cannot be told apart: a subject is then one recording of action
    ``unknown``, with a warning. Raises GhptDataError if a file is missing, damaged or not what it
    should be.
    """
    labels = read_labels(_labels_file(root))
    check_names(labels.path, numbers, range(len(labels.cameras)))
    for name in _subjects(split):
        subject = _subject(root, name, labels, list(numbers))
        for take, (action, rows, frame) in _takes(subject, labels, damaged).items():
            if damaged or take not in DAMAGED:
                yield _recording(subject, take, action, rows, frame)


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


def _subjects(split: str) -> tuple[str, ...]:
    check(split in SUBJECTS, "split", f"is {split!r}", f"Existing: {', '.join(SUBJECTS)}.")
    return SUBJECTS[split]


def _labels_file(root: Path) -> Path:
    for file in (root / LABELS_FILE, root / "extra" / LABELS_FILE):
        if file.is_file():
            return file
    raise GhptDataError(
        root, "", f"there is no {LABELS_FILE}, nor extra/{LABELS_FILE}", "Put karfly's file there."
    )


def _chunks(folder: Path) -> list[tuple[Path, Path, Path]]:
    """Predictions, boxes and truth of each chunk, in order."""
    files = folder.iterdir() if folder.is_dir() else ()
    found = {int(m[1]) for f in files if (m := re.fullmatch(r"all_2d_preds(\d+)\.npy", f.name))}
    chunks = [
        tuple(folder / f"{name}{n}.npy" for name in ("all_2d_preds", "all_bboxes", "all_3d_gt"))
        for n in range(max(found, default=0) + 1)
    ]
    for file in (file for chunk in chunks for file in chunk):
        if not file.is_file():
            raise GhptDataError(file, "", "there is no such file", _LAYOUT)
    return chunks


def _subject(root: Path, name: str, labels: Labels, views: list[int]) -> _Subject:
    if name not in labels.subjects:
        problem = f"there is no {name}"
        raise GhptDataError(
            labels.path, "subject_names", problem, "Get the labels of all seven subjects."
        )
    index = labels.subjects.index(name)
    all_views = len(labels.cameras)
    camera_names = tuple(labels.cameras[v] for v in views)
    rig = (x[index][views] for x in (labels.K, labels.R, labels.t, labels.distortion))
    cameras, distortion = check_cameras(f"{labels.path} ({name})", camera_names, *rig)
    predictions = []
    boxes = []
    truth = []
    for files in _chunks(root / name):
        predictions.append(read_npy(files[0], (None, all_views, 17, 2), "f"))
        boxes.append(read_npy(files[1], (len(predictions[-1]), all_views, 2, 2), "fiu"))
        truth.append(read_npy(files[2], (len(predictions[-1]), 17, 3), "f"))
    return _Subject(
        name, index, views, camera_names, cameras, distortion, predictions, boxes, truth
    )


def _takes(
    subject: _Subject, labels: Labels, damaged: bool
) -> dict[str, tuple[str, Int[np.ndarray, " T"], Int[np.ndarray, " T"]]]:
    """Take's name -> action, rows of the subject's chunks, frame numbers."""
    rows = np.flatnonzero(labels.subject == subject.index)
    length = sum(map(len, subject.truth))
    if len(rows) != length or not _same(labels, rows, subject.truth):
        if not damaged and any(take.startswith(f"{subject.name}/") for take in DAMAGED):
            problem = "the chunks' frames are not the labels', so damaged takes cannot be left out"
            raise GhptDataError(
                labels.path,
                subject.name,
                problem,
                "Predict all frames of the labels, or set damaged.",
            )
        problem = "the chunks' frames are not the labels', so this subject is one recording of unknown action"
        warnings.warn(f"{labels.path}: {subject.name}: {problem}", stacklevel=2)
        return {f"{subject.name}/unknown": ("unknown", np.arange(length), np.arange(length))}
    action = labels.action[rows]
    return {
        f"{subject.name}/{labels.actions[a]}": (
            labels.actions[a].rsplit("-", 1)[0],
            np.flatnonzero(action == a),
            labels.frame[rows[action == a]],
        )
        for a in np.unique(action)
    }


def _same(labels: Labels, rows: Int[np.ndarray, " T"], truth: list[np.ndarray]) -> bool:
    starts = np.cumsum([0, *map(len, truth)])
    return all(
        not (np.abs(labels.key_points[rows[start : start + len(chunk)]] - chunk) > _SAME_MM).any()
        for start, chunk in zip(starts, truth, strict=False)
    )


def _recording(
    subject: _Subject,
    take: str,
    action: str,
    rows: Int[np.ndarray, " T"],
    frame: Int[np.ndarray, " T"],
) -> LabelledRecording:
    frames = len(rows)
    views = len(subject.views)
    key_points = np.empty((frames, views, 17, 2), np.float32)
    valid = np.empty((frames, views, 17), np.bool_)
    truth = np.empty((frames, 17, 3), np.float32)
    for start in range(0, frames, _BLOCK):
        block = slice(start, start + _BLOCK)
        pixels, there = in_image(
            _pick(subject.predictions, rows[block])[:, subject.views].astype(np.float64),
            _pick(subject.boxes, rows[block])[:, subject.views].astype(np.float64),
        )
        truth[block] = _pick(subject.truth, rows[block])
        for view in range(views):
            key_points[block, view], valid[block, view] = undistorted(
                pixels[:, view],
                there[:, view],
                subject.cameras.K[view].numpy(),
                subject.distortion[view],
            )
    truth_valid = np.isfinite(truth).all(-1)
    truth[~truth_valid] = 0
    return LabelledRecording(
        name=take,
        subject=subject.name,
        action=action,
        rate_hz=_RATE_HZ,
        camera_names=subject.camera_names,
        cameras=subject.cameras,
        key_points=key_points,
        confidence=np.ones(valid.shape, np.float32),
        valid=valid,
        truth=truth,
        truth_valid=truth_valid,
        frame=frame.astype(np.int64),
    )


def _pick(chunks: list[np.ndarray], rows: Int[np.ndarray, " T"]) -> np.ndarray:
    """Ascending rows of the chunks' concatenation."""
    starts = np.cumsum([0, *map(len, chunks)])
    return np.concatenate(
        [
            chunk[rows[(rows >= a) & (rows < a + len(chunk))] - a]
            for a, chunk in zip(starts, chunks, strict=False)
        ]
    )
