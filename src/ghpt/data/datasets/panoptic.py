"""CMU Panoptic Studio in its own layout, with the user's 2D detections beside it.

A root holds sequences: ``<seq>/calibration_<seq>.json``,
``<seq>/hdPose3d_stage1_coco19/body3DScene_%08d.json`` and either ``<seq>/keypoints/00_%02d.npz``
for each HD camera, or the authors' ``<seq>/all_2d_preds.npy``.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from ghpt.data.datasets.detections import undistorted
from ghpt.data.datasets.panoptic_detections import detection_files, detections, hd_name
from ghpt.data.formats.validate import check_array, check_cameras, check_names, read_json
from ghpt.errors import GhptDataError, check
from ghpt.geometry.cameras import Cameras
from ghpt.observations import LabelledRecording
from ghpt.skeleton import JOINT

SPLITS = {"train": (0.0, 0.6), "validation": (0.6, 0.8), "test": (0.8, 1.0)}
"""Split -> its part of each sequence in time (paper, section 4.1)."""

COCO19 = (
    "neck",
    "nose",
    "mid_hip",
    "left_shoulder",
    "left_elbow",
    "left_wrist",
    "left_hip",
    "left_knee",
    "left_ankle",
    "right_shoulder",
    "right_elbow",
    "right_wrist",
    "right_hip",
    "right_knee",
    "right_ankle",
    "left_eye",
    "left_ear",
    "right_eye",
    "right_ear",
)
"""Joints of the body3DScene files, in their order."""

_PARTS = {name: (name,) for name in JOINT if name in COCO19} | {
    "pelvis": ("mid_hip",),
    "thorax": ("neck",),
    "spine": ("neck", "mid_hip"),
    "head_top": ("left_eye", "right_eye", "left_ear", "right_ear"),
}
_RATE_HZ = 29.97
_MM = 10.0
"""Millimetres in Panoptic's unit."""
_SCENES = "hdPose3d_stage1_coco19"
_GET = "Get the file again from the Panoptic Studio tool box."


def panoptic_files(root: Path, numbers: Sequence[int]) -> list[Path]:
    """The files that the recordings of these HD cameras are made of. Raises GhptDataError if one is
    missing.
    """
    files = []
    for folder in _sequences(root):
        files += [
            _calibration(folder),
            *_scenes(folder).values(),
            *detection_files(folder, numbers),
        ]
    return files


def panoptic_recordings(
    root: Path, numbers: Sequence[int], split: str
) -> Iterator[LabelledRecording]:
    """One recording for each sequence: the split's part in time, in the HD cameras ``numbers``.

    Frames are those of the 3D files, so that the split is the same for all cameras; detections are
    matched by frame number, and a frame without them is not seen. Of several bodies, the truth is
    the id that is there in most of the split's frames. Raises GhptDataError if a file is missing,
    damaged or not what it should be.
    """
    check(split in SPLITS, "split", f"is {split!r}", f"Existing: {', '.join(SPLITS)}.")
    for folder in _sequences(root):
        scenes = _scenes(folder)
        start, end = (int(part * len(scenes)) for part in SPLITS[split])
        frame = np.array(list(scenes)[start:end], dtype=np.int64)
        truth, truth_valid = _truth([scenes[number] for number in frame])
        names, cameras, distortion = _cameras(folder, numbers)
        shape = (len(frame), len(numbers), len(JOINT))
        key_points = np.zeros((*shape, 2), np.float32)
        valid = np.zeros(shape, np.bool_)
        confidence = np.zeros(shape, np.float32)
        for view, found in enumerate(detections(folder, numbers, list(scenes))):
            _, here, there = np.intersect1d(frame, found["frame"], return_indices=True)
            confidence[here, view] = found["confidence"][there]
            key_points[here, view], valid[here, view] = undistorted(
                found["key_points"][there],
                found["seen"][there],
                cameras.K[view].numpy(),
                distortion[view],
            )
        yield LabelledRecording(
            name=folder.name,
            subject=folder.name,
            action=_action(folder.name),
            rate_hz=_RATE_HZ,
            camera_names=names,
            cameras=cameras,
            key_points=key_points,
            confidence=np.where(valid, confidence, 0).astype(np.float32),
            valid=valid,
            truth=truth,
            truth_valid=truth_valid,
            frame=frame,
        )


def joints17(
    joints19: Float[np.ndarray, "T 19 3"], there: Bool[np.ndarray, "T 19"]
) -> tuple[Float[np.ndarray, "T 17 3"], Bool[np.ndarray, "T 17"]]:
    """COCO19 as the 17 joints, by name. A mean (spine, head top) is there if all of its joints are."""
    parts = [[COCO19.index(name) for name in _PARTS[joint]] for joint in JOINT]
    points = np.stack([joints19[:, part].mean(1) for part in parts], axis=1)
    valid = np.stack([there[:, part].all(1) for part in parts], axis=1)
    return np.where(valid[..., None], points, 0).astype(np.float32), valid


def _sequences(root: Path) -> list[Path]:
    folders = sorted(root.iterdir()) if root.is_dir() else []
    sequences = [folder for folder in folders if _calibration(folder).is_file()]
    if not sequences:
        problem = "there is no <seq>/calibration_<seq>.json below"
        raise GhptDataError(
            root, "", problem, "data.root must be the folder that holds the sequences' folders."
        )
    return sequences


def _calibration(folder: Path) -> Path:
    return folder / f"calibration_{folder.name}.json"


def _scenes(folder: Path) -> dict[int, Path]:
    """Frame number -> 3D file, in order of time."""
    files = (folder / _SCENES).iterdir() if (folder / _SCENES).is_dir() else ()
    scenes = {
        int(m[1]): f for f in files if (m := re.fullmatch(r"body3DScene_(\d{1,12})\.json", f.name))
    }
    if not scenes:
        raise GhptDataError(folder / _SCENES, "", "there is no body3DScene_<frame>.json", _GET)
    return dict(sorted(scenes.items()))


def _action(name: str) -> str:
    """``171026_pose3`` -> ``pose``."""
    return name.partition("_")[2].rstrip("0123456789") or "unknown"


def _cameras(
    folder: Path, numbers: Sequence[int]
) -> tuple[tuple[str, ...], Cameras, Float[np.ndarray, "V 5"]]:
    path = _calibration(folder)
    calibration = read_json(path)
    entries = calibration.get("cameras") if isinstance(calibration, dict) else None
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise GhptDataError(path, "cameras", "is not a list of cameras", _GET)
    high = [entry for entry in entries if entry.get("type") == "hd"]
    for name in (entry.get("name") for entry in high):
        if [entry.get("name") for entry in high].count(name) > 1:
            raise GhptDataError(path, "cameras", f"camera {name} is listed twice", _GET)
    by_name = {str(entry.get("name")): entry for entry in high}
    names = tuple(hd_name(number) for number in numbers)
    check_names(path, names, sorted(by_name))
    values = {
        field: np.stack([_numbers(path, name, by_name[name], field, shape) for name in names])
        for field, shape in {"K": (3, 3), "R": (3, 3), "t": (3, 1), "distCoef": (5,)}.items()
    }
    t = values["t"][..., 0] * _MM
    cameras, distortion = check_cameras(
        path, names, values["K"], values["R"], t, values["distCoef"]
    )
    return names, cameras, distortion


def _numbers(
    path: Path, where: str, entry: dict[str, Any], field: str, shape: tuple[int, ...]
) -> np.ndarray:
    try:
        array = np.array(entry[field])
    except KeyError as error:
        raise GhptDataError(path, f"{where}, {field}", "is missing", _GET) from error
    except (ValueError, OverflowError) as error:
        raise GhptDataError(
            path, f"{where}, {field}", "is not an array of numbers", _GET
        ) from error
    return check_array(path, f"{where}, {field}", array, shape, "fiu").astype(np.float64)


def _truth(files: Sequence[Path]) -> tuple[Float[np.ndarray, "T 17 3"], Bool[np.ndarray, "T 17"]]:
    """The poses (mm) of the body that is there in most files; where it is not, no joint is seen."""
    scenes = [_bodies(file) for file in files]
    counts = Counter(body for scene in scenes for body in scene)
    person = min(counts, key=lambda body: (-counts[body], body), default=0)
    nobody = np.full((len(COCO19), 4), -1.0)
    joints = (
        np.stack([scene.get(person, nobody) for scene in scenes])
        if scenes
        else np.empty((0, *nobody.shape))
    )
    return joints17(joints[..., :3] * _MM, joints[..., 3] >= 0)


def _bodies(path: Path) -> dict[int, Float[np.ndarray, "19 4"]]:
    """Id -> x, y, z (cm) and score."""
    scene = read_json(path)
    bodies = scene.get("bodies") if isinstance(scene, dict) else None
    if not isinstance(bodies, list) or not all(isinstance(body, dict) for body in bodies):
        raise GhptDataError(path, "bodies", "is not a list of bodies", _GET)
    found: dict[int, np.ndarray] = {}
    for body in bodies:
        number = body.get("id")
        if type(number) is not int or number in found:
            raise GhptDataError(
                path, "id", f"is {number!r}: not a whole number, or there twice", _GET
            )
        found[number] = _numbers(
            path, f"body {number}", body, "joints19", (4 * len(COCO19),)
        ).reshape(-1, 4)
        if not (np.abs(found[number]) < 1e6).all():
            raise GhptDataError(
                path, f"body {number}, joints19", "is not finite, or beyond 10 km", _GET
            )
    return found
