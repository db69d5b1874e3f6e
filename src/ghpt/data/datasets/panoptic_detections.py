"""The user's 2D detections beside a Panoptic sequence: a file for each camera, or one array."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from ghpt.data.datasets.detections import uncrop
from ghpt.data.formats.validate import check_array, check_names, read_json, read_npy, read_npz
from ghpt.errors import GhptDataError
from ghpt.skeleton import JOINT

HD_CAMERAS = 31


@dataclass(frozen=True)
class CameraDetections:
    """What the detector found in one camera."""

    frame: Int[np.ndarray, " N"]
    """Panoptic's frame numbers, each once."""
    key_points: Float[np.ndarray, "N 17 2"]
    """Raw pixels."""
    confidence: Float[np.ndarray, "N 17"]
    valid: Bool[np.ndarray, "N 17"]


def hd_name(number: int) -> str:
    """Return Panoptic's name of an HD camera."""
    return f"00_{number:02d}"


def detection_files(folder: Path, numbers: Sequence[int]) -> list[Path]:
    """Return a sequence's files: one per camera, or the authors' array with what lies beside it."""
    check_names(folder, numbers, range(HD_CAMERAS))
    own = folder / "keypoints"
    if own.is_dir() and is_own_layout(folder, numbers):
        files = _own_files(folder, numbers)
        for file in files:
            if not file.is_file():
                hint = "Each camera of the arrangement needs one."
                raise GhptDataError(file, "", "there is no such file", hint)
        return files
    if own.is_dir():
        return sorted(file for file in own.rglob("*") if file.is_file())
    if (folder / "all_2d_preds.npy").is_file():
        names = ("all_2d_preds.npy", "all_bboxes.npy", "all_frames.npy", "all_cameras.json")
        files = [folder / name for name in names]
        return [file for file in files if file.is_file()]
    problem = "there is neither keypoints/ nor all_2d_preds.npy"
    hint = "Run a 2D detector on the HD videos and put its key points there."
    raise GhptDataError(folder, "", problem, hint)


def is_own_layout(folder: Path, numbers: Sequence[int]) -> bool:
    """Return whether detections are an npz file for each camera, or the authors' array."""
    own = folder / "keypoints"
    return not own.is_dir() or any(file.is_file() for file in _own_files(folder, numbers))


def _own_files(folder: Path, numbers: Sequence[int]) -> list[Path]:
    return [folder / "keypoints" / f"{hd_name(number)}.npz" for number in numbers]


def read_detections(
    folder: Path,
    numbers: Sequence[int],
    frames: Sequence[int],
) -> Iterator[CameraDetections]:
    """Yield the detections of each camera.

    ``frames`` are the sequence's. Raises GhptDataError if a file is missing, damaged or not what it
    should be.
    """
    files = detection_files(folder, numbers)
    if files[0].name == "all_2d_preds.npy":
        for detections in _read_authors(folder, numbers, frames):
            _check_frames(files[0], detections, frames)
            yield detections
        return
    for file in files:
        detections = _read_own(file)
        _check_frames(file, detections, frames)
        yield detections


def _check_frames(file: Path, detections: CameraDetections, frames: Sequence[int]) -> None:
    found = detections.frame
    if len(np.unique(found)) != len(found):
        hint = "Keep one detection for each frame."
        raise GhptDataError(file, "frame", "holds a frame number twice", hint)
    if not np.isin(found, frames).any():
        problem = (
            f"holds none of the frames {min(frames)} to {max(frames)} of the body3DScene files"
        )
        raise GhptDataError(file, "frame", problem, "Number the frames as Panoptic does.")


def _read_own(file: Path) -> CameraDetections:
    """Read one camera's npz file."""
    joints = len(JOINT)
    arrays = read_npz(
        file,
        {
            "frame": ((None,), "iu"),
            "key_points": ((None, joints, 2), "f"),
            "confidence": ((None, joints), "f"),
            "seen": ((None, joints), "b"),
        },
    )
    frame = arrays["frame"]
    count = len(frame)
    key_points = check_array(file, "key_points", arrays["key_points"], (count, joints, 2), "f")
    confidence = check_array(file, "confidence", arrays["confidence"], (count, joints), "f")
    valid = check_array(file, "seen", arrays["seen"], (count, joints), "b")
    own_confidence = confidence[valid]
    if not ((own_confidence >= 0) & (own_confidence <= 1)).all():
        problem = "is not between 0 and 1 everywhere"
        raise GhptDataError(file, "confidence", problem, "Scale it, or mask with seen.")
    return CameraDetections(frame.astype(np.int64), key_points, confidence, valid)


def _read_authors(
    folder: Path,
    numbers: Sequence[int],
    frames: Sequence[int],
) -> Iterator[CameraDetections]:
    """Yield the cameras of the authors' array, which has no confidence: it is taken as 1."""
    path = folder / "all_2d_preds.npy"
    names = _read_camera_names(folder)
    wanted = [hd_name(number) for number in numbers]
    check_names(path, names)
    check_names(path, wanted, names)
    predictions = read_npy(path, (None, len(names), len(JOINT), 2), "f")
    frame = _read_frames(folder, len(predictions), frames).astype(np.int64)
    boxes = _read_boxes(folder, len(predictions), len(names))
    for name in wanted:
        index = names.index(name)
        pixels = predictions[:, index].astype(np.float64)
        valid = np.ones(pixels.shape[:-1], np.bool_)
        confidence = np.ones(valid.shape, np.float32)
        if boxes is not None:
            own_boxes = boxes[:, index].astype(np.float64)
            uncropped, has_box = uncrop(pixels[:, None], own_boxes[:, None])
            pixels = uncropped[:, 0]
            valid = has_box[:, 0]
        yield CameraDetections(frame, pixels, confidence, valid)


def _read_camera_names(folder: Path) -> list[str]:
    """Return the names of the cameras of the authors' array: all HD cameras, or those of a file."""
    path = folder / "all_cameras.json"
    if not path.is_file():
        return [hd_name(number) for number in range(HD_CAMERAS)]
    names = read_json(path)
    if not isinstance(names, list):
        raise GhptDataError(path, "", "is not a list", 'Write ["00_03", "00_06", ...].')
    return names


def _read_frames(folder: Path, count: int, frames: Sequence[int]) -> np.ndarray:
    """Return the frame numbers of the authors' array."""
    path = folder / "all_frames.npy"
    if path.is_file():
        return read_npy(path, (count,), "iu")
    if count != len(frames):
        problem = f"has {count} frames, and there are {len(frames)} body3DScene files"
        hint = "Put the frame numbers beside it, as all_frames.npy."
        raise GhptDataError(folder / "all_2d_preds.npy", "", problem, hint)
    return np.array(frames)


def _read_boxes(folder: Path, frames: int, views: int) -> np.ndarray | None:
    path = folder / "all_bboxes.npy"
    return read_npy(path, (frames, views, 2, 2), "fiu") if path.is_file() else None
