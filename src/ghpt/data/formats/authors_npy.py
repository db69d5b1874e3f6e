"""The 2D predictions of the paper's authors: all_2d_preds.npy and what lies beside it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int

from ghpt.data.datasets.detections import uncrop
from ghpt.data.formats.validate import check_view_count, finite_points, read_json, read_npy
from ghpt.data.people.detections import Detections, joints_for
from ghpt.data.points import KeyPoints
from ghpt.errors import GhptDataError

_FARTHEST = 1e6
"""Pixels."""
_LAYOUT = (
    "A folder must hold all_2d_preds.npy and all_bboxes.npy, "
    "or all_2d_preds<n>.npy and all_bboxes<n>.npy."
)


def is_authors_file(path: Path) -> bool:
    """Return whether a file has the name of the authors' predictions."""
    return re.fullmatch(r"all_2d_preds\d*\.npy", path.name) is not None


def read_authors(path: Path, skeleton: str | None) -> Detections:
    """Return the one person of a folder of predictions, or of one of its files.

    The predictions [T, V, 17, 2] are in pixels of the 384-high crop; chunks 0, 1, ... follow one
    another. They come back into the image by all_bboxes.npy [T, V, 2, 2] (two corners), which must
    be there; a box without height is a view in which nobody is. Optional: all_frames.npy [T], frame
    numbers; all_cameras.json, a list of the views' names (else ``cam_0``, ``cam_1``, ...). Joints
    are the project's 17 unless ``skeleton`` says another; there is no confidence. Raises
    GhptDataError.
    """
    folder = path if path.is_dir() else path.parent
    pixels: list[np.ndarray] = []
    there: list[np.ndarray] = []
    for chunk in _chunks(folder, path):
        found, valid = _read_chunk(chunk)
        if pixels and found.shape[1:] != pixels[0].shape[1:]:
            _, views, count, _ = found.shape
            problem = f"has {views} views of {count} joints, the chunks before others"
            hint = "Keep the chunks of one rig in a folder."
            raise GhptDataError(chunk.predictions, "", problem, hint)
        pixels.append(found)
        there.append(valid)
    valid = np.concatenate(there)
    points = np.where(valid[..., None], np.concatenate(pixels), 0)
    if (np.abs(points) >= _FARTHEST).any():
        hint = "Detect again; check the boxes."
        raise GhptDataError(path, "", "holds a number beyond 1e6", hint)
    frames, views, count, _ = points.shape
    names = _view_names(folder, views)
    joints = joints_for(path, skeleton or "human36m", count)
    key_points = KeyPoints(points, valid.astype(np.float64), valid)
    frame = _frame_numbers(folder, frames)
    return Detections.of_person(path, names, joints, frame, key_points)


@dataclass(frozen=True)
class _Chunk:
    """Files that belong together."""

    predictions: Path
    boxes: Path


def _chunks(folder: Path, path: Path) -> list[_Chunk]:
    """Return the chunks of a folder in order, or the one of a file. Raises GhptDataError."""
    if path.is_file():
        match = re.fullmatch(r"all_2d_preds(\d*)\.npy", path.name)
        if not match:
            raise GhptDataError(path, "", "is no file of predictions", _LAYOUT)
        return [_Chunk(path, folder / f"all_bboxes{match[1]}.npy")]
    numbers = set()
    for file in folder.iterdir():
        match = re.fullmatch(r"all_2d_preds(\d{1,6})\.npy", file.name)
        if match:
            numbers.add(int(match[1]))
    if not numbers:
        return [_Chunk(folder / "all_2d_preds.npy", folder / "all_bboxes.npy")]
    chunks = []
    for number in range(max(numbers) + 1):
        predictions = folder / f"all_2d_preds{number}.npy"
        if number not in numbers:
            raise GhptDataError(predictions, "", "there is no such file", _LAYOUT)
        chunks.append(_Chunk(predictions, folder / f"all_bboxes{number}.npy"))
    return chunks


def _read_chunk(chunk: _Chunk) -> tuple[np.ndarray, np.ndarray]:
    """Return the image pixels [T V K 2] of a chunk, and which are valid."""
    crop = read_npy(chunk.predictions, (None, None, None, 2), "f")
    check_view_count(chunk.predictions, crop.shape[1])
    if not chunk.boxes.is_file():
        problem = "there is no such file: the predictions are in pixels of a crop"
        raise GhptDataError(chunk.boxes, "", problem, _LAYOUT)
    corners = read_npy(chunk.boxes, (*crop.shape[:2], 2, 2), "fiu")
    with np.errstate(over="ignore", invalid="ignore"):
        pixels, valid = uncrop(crop.astype(np.float64), corners.astype(np.float64))
    return pixels, valid & finite_points(pixels)


def _frame_numbers(folder: Path, count: int) -> Int[np.ndarray, " T"]:
    file = folder / "all_frames.npy"
    frame = np.arange(count)
    if file.is_file():
        frame = read_npy(file, (count,), "iu").astype(np.int64)
    if not count or (np.diff(frame) <= 0).any():
        problem = "is empty, or does not rise"
        raise GhptDataError(folder, "all_frames.npy", problem, "Number the frames in order.")
    return frame


def _view_names(folder: Path, views: int) -> tuple[str, ...]:
    file = folder / "all_cameras.json"
    if not file.is_file():
        return tuple(f"cam_{view}" for view in range(views))
    listed = read_json(file)
    names = tuple(map(str, listed)) if isinstance(listed, list) else ()
    if len(names) != views or len(set(names)) != views:
        problem = f"is not a list of {views} different names"
        raise GhptDataError(file, "", problem, 'Write ["00_03", "00_06", ...].')
    return names
