"""The user's 2D detections beside a Panoptic sequence: a file per HD camera, or the authors' one
array.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from ghpt.data.datasets.detections import in_image
from ghpt.data.formats.validate import check_array, check_names, read_json, read_npy, read_npz
from ghpt.errors import GhptDataError
from ghpt.skeleton import JOINT

_HD_CAMERAS = 31


def hd_name(number: int) -> str:
    """Panoptic's name of an HD camera."""
    return f"00_{number:02d}"


def detection_files(folder: Path, numbers: Sequence[int]) -> list[Path]:
    """Of this sequence: one file per camera, or the authors' array with what lies beside it."""
    check_names(folder, numbers, range(_HD_CAMERAS))
    files = [folder / "keypoints" / f"{hd_name(number)}.npz" for number in numbers]
    if (folder / "keypoints").is_dir():
        for file in files:
            if not file.is_file():
                raise GhptDataError(
                    file, "", "there is no such file", "Each camera of the arrangement needs one."
                )
        return files
    if (folder / "all_2d_preds.npy").is_file():
        names = ("all_2d_preds.npy", "all_bboxes.npy", "all_frames.npy", "all_cameras.json")
        return [folder / name for name in names if (folder / name).is_file()]
    problem = "there are neither keypoints/00_<camera>.npz nor all_2d_preds.npy"
    raise GhptDataError(
        folder, "", problem, "Run a 2D detector on the HD videos and put its key points there."
    )


def detections(
    folder: Path, numbers: Sequence[int], frames: Sequence[int]
) -> Iterator[dict[str, np.ndarray]]:
    """For each camera: frame [N], key_points [N 17 2] in raw pixels, confidence [N 17], seen [N
    17].

    ``frames`` are the sequence's. Raises GhptDataError if a file is missing, damaged or not what it
    should be.
    """
    files = detection_files(folder, numbers)
    if files[0].name == "all_2d_preds.npy":
        found = zip(files[:1] * len(numbers), _authors(folder, numbers, frames), strict=True)
    else:
        found = ((file, _own(file)) for file in files)
    for file, arrays in found:
        arrays["frame"] = arrays["frame"].astype(np.int64)
        if len(np.unique(arrays["frame"])) != len(arrays["frame"]):
            raise GhptDataError(
                file, "frame", "holds a frame number twice", "Keep one detection for each frame."
            )
        if not np.isin(arrays["frame"], frames).any():
            problem = (
                f"holds none of the frames {min(frames)} to {max(frames)} of the body3DScene files"
            )
            raise GhptDataError(file, "frame", problem, "Number the frames as Panoptic does.")
        yield arrays


def _own(file: Path) -> dict[str, np.ndarray]:
    joints = len(JOINT)
    fields = {
        "frame": ((None,), "iu"),
        "key_points": ((None, joints, 2), "f"),
        "confidence": ((None, joints), "f"),
        "seen": ((None, joints), "b"),
    }
    arrays = read_npz(file, fields)
    for field, (shape, kinds) in fields.items():
        check_array(file, field, arrays[field], (len(arrays["frame"]), *shape[1:]), kinds)
    confidence = arrays["confidence"][arrays["seen"]]
    if not ((confidence >= 0) & (confidence <= 1)).all():
        raise GhptDataError(
            file, "confidence", "is not between 0 and 1 everywhere", "Scale it, or mask with seen."
        )
    return arrays


def _authors(
    folder: Path, numbers: Sequence[int], frames: Sequence[int]
) -> Iterator[dict[str, np.ndarray]]:
    path = folder / "all_2d_preds.npy"
    names = [hd_name(number) for number in range(_HD_CAMERAS)]
    if (folder / "all_cameras.json").is_file():
        names = read_json(folder / "all_cameras.json")
        if not isinstance(names, list):
            raise GhptDataError(
                folder / "all_cameras.json", "", "is not a list", 'Write ["00_03", "00_06", ...].'
            )
    wanted = [hd_name(number) for number in numbers]
    check_names(path, names)
    check_names(path, wanted, names)
    predictions = read_npy(path, (None, len(names), len(JOINT), 2), "f")
    if (folder / "all_frames.npy").is_file():
        frame = read_npy(folder / "all_frames.npy", (len(predictions),), "iu")
    elif len(predictions) == len(frames):
        frame = np.array(frames)
    else:
        problem = f"has {len(predictions)} frames, and there are {len(frames)} body3DScene files"
        raise GhptDataError(
            path, "", problem, "Put the frame numbers beside it, as all_frames.npy."
        )
    boxes = None
    if (folder / "all_bboxes.npy").is_file():
        boxes = read_npy(folder / "all_bboxes.npy", (len(predictions), len(names), 2, 2), "fiu")
    for name in wanted:
        view = slice(names.index(name), names.index(name) + 1)
        pixels = predictions[:, view].astype(np.float64)
        there = np.ones(pixels.shape[:-1], np.bool_)
        if boxes is not None:
            pixels, there = in_image(pixels, boxes[:, view].astype(np.float64))
        yield {
            "frame": frame,
            "key_points": pixels[:, 0],
            "seen": there[:, 0],
            "confidence": np.ones(there.shape[::2], np.float32),
        }
