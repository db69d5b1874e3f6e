"""The 2D predictions of the paper's authors: all_2d_preds.npy and what lies beside it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ghpt.data.datasets.detections import uncrop
from ghpt.data.formats.validate import check_view_count, read_json, read_npy
from ghpt.data.people.detections import Detections, joints_for
from ghpt.data.points import KeyPoints
from ghpt.errors import GhptDataError

_LAYOUT = (
    "A folder must hold all_2d_preds.npy and all_bboxes.npy, "
    "or all_2d_preds<n>.npy and all_bboxes<n>.npy."
)


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
    for predictions, boxes in _chunks(folder, path):
        crop = read_npy(predictions, (None, None, None, 2), "f")
        check_view_count(predictions, crop.shape[1])
        if not boxes.is_file():
            raise GhptDataError(
                boxes, "", "there is no such file: the predictions are in pixels of a crop", _LAYOUT
            )
        corners = read_npy(boxes, (*crop.shape[:2], 2, 2), "fiu").astype(np.float64)
        if pixels and crop.shape[1:] != pixels[0].shape[1:]:
            problem = (
                f"has {crop.shape[1]} views of {crop.shape[2]} joints, the chunks before others"
            )
            raise GhptDataError(predictions, "", problem, "Keep the chunks of one rig in a folder.")
        with np.errstate(over="ignore", invalid="ignore"):
            found, valid = uncrop(crop.astype(np.float64), corners)
        pixels.append(found)
        there.append(valid & np.isfinite(found).all(-1))
    valid = np.concatenate(there)
    points = np.where(valid[..., None], np.concatenate(pixels), 0)
    if (np.abs(points) >= 1e6).any():
        raise GhptDataError(path, "", "holds a number beyond 1e6", "Detect again; check the boxes.")
    frames, views, count, _ = points.shape
    frame = np.arange(frames)
    if (folder / "all_frames.npy").is_file():
        frame = read_npy(folder / "all_frames.npy", (frames,), "iu").astype(np.int64)
    if not frames or (np.diff(frame) <= 0).any():
        raise GhptDataError(
            folder, "all_frames.npy", "is empty, or does not rise", "Number the frames in order."
        )
    names = _names(folder, views)
    joints = joints_for(path, skeleton or "human36m", count)
    key_points = KeyPoints(points, valid.astype(np.float64), valid)
    return Detections.of_person(path, names, joints, frame, key_points)


def _chunks(folder: Path, path: Path) -> list[tuple[Path, Path]]:
    numbered = {
        int(m[1])
        for f in folder.iterdir()
        if (m := re.fullmatch(r"all_2d_preds(\d{1,6})\.npy", f.name))
    }
    if path.is_file():
        if not (match := re.fullmatch(r"all_2d_preds(\d*)\.npy", path.name)):
            raise GhptDataError(path, "", "is no file of predictions", _LAYOUT)
        return [(path, folder / f"all_bboxes{match[1]}.npy")]
    if not numbered:
        return [(folder / "all_2d_preds.npy", folder / "all_bboxes.npy")]
    for number in range(max(numbered)):
        if number not in numbered:
            raise GhptDataError(
                folder / f"all_2d_preds{number}.npy", "", "there is no such file", _LAYOUT
            )
    return [
        (folder / f"all_2d_preds{n}.npy", folder / f"all_bboxes{n}.npy") for n in sorted(numbered)
    ]


def _names(folder: Path, views: int) -> tuple[str, ...]:
    file = folder / "all_cameras.json"
    if not file.is_file():
        return tuple(f"cam_{view}" for view in range(views))
    names = read_json(file)
    if not isinstance(names, list) or len(names) != views or len({*map(str, names)}) != views:
        raise GhptDataError(
            file, "", f"is not a list of {views} different names", 'Write ["00_03", "00_06", ...].'
        )
    return tuple(map(str, names))
