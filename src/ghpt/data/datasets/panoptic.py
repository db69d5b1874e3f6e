"""CMU Panoptic Studio in its own layout, with the user's 2D detections beside it.

A root holds sequences: ``<seq>/calibration_<seq>.json``,
``<seq>/hdPose3d_stage1_coco19/body3DScene_%08d.json`` and ``<seq>/keypoints/``, with 00_%02d.npz
for each HD camera or a detector's files in any format that is read, or the authors'
``<seq>/all_2d_preds.npy``. Or it is the authors' own flat folder
(``ghpt.data.datasets.cmu_authors``).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from ghpt.data.datasets.cmu_authors import authors_files, authors_recording, is_authors_folder
from ghpt.data.datasets.detections import undistort_key_points
from ghpt.data.datasets.panoptic_detections import (
    HD_CAMERAS,
    detection_files,
    hd_name,
    is_own_layout,
    read_detections,
)
from ghpt.data.datasets.panoptic_joints import COCO19, joints17
from ghpt.data.datasets.panoptic_key_points import read_person
from ghpt.data.formats.validate import check_array, check_cameras, check_names, read_json
from ghpt.data.points import KeyPoints
from ghpt.errors import GhptDataError, check
from ghpt.geometry.cameras import Cameras
from ghpt.observations import LabelledRecording
from ghpt.skeleton import JOINT

SPLITS = {"train": (0.0, 0.6), "validation": (0.6, 0.8), "test": (0.8, 1.0)}
"""Split -> its part of each sequence in time (paper, section 4.1)."""

_RATE_HZ = 29.97
_MM = 10.0
"""Millimetres in Panoptic's unit."""
_SCENES = "hdPose3d_stage1_coco19"
_GET = "Get the file again from the Panoptic Studio tool box."


def panoptic_files(root: Path, numbers: Sequence[int]) -> list[Path]:
    """Return the files that the recordings of these HD cameras are made of.

    Raises GhptDataError if one is missing.
    """
    if is_authors_folder(root):
        check_names(root, numbers, range(HD_CAMERAS))
        return authors_files(root)
    files = []
    for folder in _sequences(root):
        files.append(_calibration_file(folder))
        files += _scene_files(folder).values()
        files += detection_files(folder, numbers)
    return files


def panoptic_recordings(
    root: Path,
    numbers: Sequence[int],
    split: str,
) -> Iterator[LabelledRecording]:
    """Yield one recording for each sequence: the split's part in time, in these HD cameras.

    The authors' flat folder, in which sequences are not told apart, is one.

    Frames are those of the 3D files, so that the split is the same for all cameras; detections are
    matched by frame number, and a frame without them has no valid key points. Of several bodies,
    the truth is the id that is there in most of the split's frames. Raises GhptDataError if a file
    is missing, damaged or not what it should be.
    """
    check(split in SPLITS, "split", f"is {split!r}", f"Existing: {', '.join(SPLITS)}.")
    if is_authors_folder(root):
        yield authors_recording(root, numbers, SPLITS[split])
        return
    for folder in _sequences(root):
        yield _read_recording(folder, numbers, split)


def _read_recording(folder: Path, numbers: Sequence[int], split: str) -> LabelledRecording:
    scenes = _scene_files(folder)
    start, end = (int(part * len(scenes)) for part in SPLITS[split])
    frame = np.array(list(scenes)[start:end], dtype=np.int64)
    truth, truth_valid = _read_truth([scenes[number] for number in frame])
    names = tuple(hd_name(number) for number in numbers)
    cameras, distortion = _read_cameras(folder, names)
    if is_own_layout(folder, numbers):
        points = _read_own(folder, numbers, cameras, distortion, frame, list(scenes))
    else:
        own = folder / "keypoints"
        calibration = _calibration_file(folder)
        points = read_person(own, calibration, names, frame, truth, truth_valid)
    return LabelledRecording(
        name=folder.name,
        subject=folder.name,
        action=_action(folder.name),
        rate_hz=_RATE_HZ,
        camera_names=names,
        cameras=cameras,
        key_points=points.pixels.astype(np.float32),
        confidence=np.where(points.valid, points.confidence, 0).astype(np.float32),
        valid=points.valid,
        truth=truth,
        truth_valid=truth_valid,
        frame=frame,
    )


def _read_own(
    folder: Path,
    numbers: Sequence[int],
    cameras: Cameras,
    distortion: Float[np.ndarray, "V 5"],
    frame: Int[np.ndarray, " T"],
    frames: Sequence[int],
) -> KeyPoints:
    """Return the key points [T V 17] of the npz files, or of the authors' array, undistorted.

    ``frames`` are the sequence's, ``frame`` those of the split.
    """
    shape = (len(frame), len(numbers), len(JOINT))
    key_points = np.zeros((*shape, 2), np.float32)
    valid = np.zeros(shape, np.bool_)
    confidence = np.zeros(shape, np.float32)
    for view, found in enumerate(read_detections(folder, numbers, frames)):
        _, rows, found_rows = np.intersect1d(frame, found.frame, return_indices=True)
        confidence[rows, view] = found.confidence[found_rows]
        key_points[rows, view], valid[rows, view] = undistort_key_points(
            found.key_points[found_rows],
            found.valid[found_rows],
            cameras.K[view].numpy(),
            distortion[view],
        )
    return KeyPoints(key_points, confidence, valid)


def _sequences(root: Path) -> list[Path]:
    folders = sorted(root.iterdir()) if root.is_dir() else []
    sequences = [folder for folder in folders if _calibration_file(folder).is_file()]
    if not sequences:
        problem = "there is no <seq>/calibration_<seq>.json below"
        hint = "data.root must be the folder that holds the sequences' folders."
        raise GhptDataError(root, "", problem, hint)
    return sequences


def _calibration_file(folder: Path) -> Path:
    return folder / f"calibration_{folder.name}.json"


def _scene_files(folder: Path) -> dict[int, Path]:
    """Return the 3D files by frame number, in order of time."""
    scenes = folder / _SCENES
    files = scenes.iterdir() if scenes.is_dir() else ()
    by_frame = {}
    for file in files:
        match = re.fullmatch(r"body3DScene_(\d{1,12})\.json", file.name)
        if match:
            by_frame[int(match[1])] = file
    if not by_frame:
        raise GhptDataError(scenes, "", "there is no body3DScene_<frame>.json", _GET)
    return dict(sorted(by_frame.items()))


def _action(name: str) -> str:
    """Return ``pose`` of ``171026_pose3``."""
    return name.partition("_")[2].rstrip("0123456789") or "unknown"


def _read_cameras(
    folder: Path,
    names: tuple[str, ...],
) -> tuple[Cameras, Float[np.ndarray, "V 5"]]:
    """Return these HD cameras, mm, and their lenses."""
    path = _calibration_file(folder)
    entries = _dicts(path, "cameras", "cameras", read_json(path))
    high = [entry for entry in entries if entry.get("type") == "hd"]
    counts = Counter(str(entry.get("name")) for entry in high)
    for name, count in counts.items():
        if count > 1:
            raise GhptDataError(path, "cameras", f"camera {name} is listed twice", _GET)
    by_name = {str(entry.get("name")): entry for entry in high}
    check_names(path, names, sorted(by_name))

    def stack(field: str, shape: tuple[int, ...]) -> np.ndarray:
        return np.stack([_numbers(path, name, by_name[name], field, shape) for name in names])

    K = stack("K", (3, 3))
    R = stack("R", (3, 3))
    t = stack("t", (3, 1))[..., 0] * _MM
    distortion = stack("distCoef", (5,))
    return check_cameras(path, names, K, R, t, distortion)


def _dicts(path: Path, key: str, plural: str, content: Any) -> list[dict[str, Any]]:
    """Return the list of dicts below a key. Raises GhptDataError if it is none."""
    entries = content.get(key) if isinstance(content, dict) else None
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise GhptDataError(path, key, f"is not a list of {plural}", _GET)
    return entries


def _numbers(
    path: Path,
    owner: str,
    entry: Mapping[str, Any],
    field: str,
    shape: tuple[int, ...],
) -> np.ndarray:
    """Return a field's numbers, float64. Raises GhptDataError if they are none of this shape."""
    where = f"{owner}, {field}"
    if field not in entry:
        raise GhptDataError(path, where, "is missing", _GET)
    try:
        array = np.array(entry[field])
    except (ValueError, OverflowError) as error:
        raise GhptDataError(path, where, "is not an array of numbers", _GET) from error
    return check_array(path, where, array, shape, "fiu").astype(np.float64)


def _read_truth(
    files: Sequence[Path],
) -> tuple[Float[np.ndarray, "T 17 3"], Bool[np.ndarray, "T 17"]]:
    """Return the poses (mm) of the body that is there in most files, and which joints are valid."""
    scenes = [_read_bodies(file) for file in files]
    counts = Counter(body for scene in scenes for body in scene)
    person = min(counts, key=lambda body: (-counts[body], body), default=0)
    nobody = np.full((len(COCO19), 4), -1.0)
    joints = np.empty((len(scenes), *nobody.shape))
    for index, scene in enumerate(scenes):
        joints[index] = scene.get(person, nobody)
    position = joints[..., :3] * _MM
    score = joints[..., 3]
    return joints17(position, score >= 0)


def _read_bodies(path: Path) -> dict[int, Float[np.ndarray, "19 4"]]:
    """Return x, y, z (cm) and score of the joints of each body, by its id."""
    found: dict[int, np.ndarray] = {}
    for body in _dicts(path, "bodies", "bodies", read_json(path)):
        number = body.get("id")
        if type(number) is not int or number in found:
            problem = f"is {number!r}: not a whole number, or there twice"
            raise GhptDataError(path, "id", problem, _GET)
        owner = f"body {number}"
        numbers = _numbers(path, owner, body, "joints19", (4 * len(COCO19),))
        if not (np.abs(numbers) < 1e6).all():
            where = f"{owner}, joints19"
            raise GhptDataError(path, where, "is not finite, or beyond 10 km", _GET)
        found[number] = numbers.reshape(-1, 4)
    return found
