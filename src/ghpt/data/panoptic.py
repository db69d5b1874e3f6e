"""CMU Panoptic Studio in its own layout, with the user's 2D detections beside it.

A root holds sequences: ``<seq>/calibration_<seq>.json``, ``<seq>/hdPose3d_stage1_coco19/body3DScene_%08d.json``
and either ``<seq>/keypoints/00_%02d.npz`` for each HD camera, or the authors' ``<seq>/all_2d_preds.npy``.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from ghpt.data.detections import in_image, undistorted
from ghpt.data.validate import check_array, check_cameras, check_names, read_json, read_npy, read_npz
from ghpt.errors import GhptDataError, check
from ghpt.geometry.cameras import Cameras
from ghpt.recording import Recording
from ghpt.skeleton import JOINT

SPLITS = {"train": (0.0, 0.6), "validation": (0.6, 0.8), "test": (0.8, 1.0)}
"""Split -> its part of each sequence in time (paper, section 4.1)."""

COCO19 = (
    "neck", "nose", "mid_hip", "left_shoulder", "left_elbow", "left_wrist", "left_hip", "left_knee", "left_ankle",
    "right_shoulder", "right_elbow", "right_wrist", "right_hip", "right_knee", "right_ankle",
    "left_eye", "left_ear", "right_eye", "right_ear",
)  # fmt: skip
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
_HD_CAMERAS = 31
_SCENES = "hdPose3d_stage1_coco19"
_GET = "Get the file again from the Panoptic Studio tool box."


def panoptic_files(root: Path, numbers: Sequence[int]) -> list[Path]:
    """The files that the recordings of these HD cameras are made of. Raises GhptDataError if one is missing."""
    files = []
    for folder in _sequences(root):
        files += [_calibration(folder), *_scenes(folder).values(), *_detection_files(folder, numbers)]
    return files


def panoptic_recordings(root: Path, numbers: Sequence[int], split: str) -> Iterator[Recording]:
    """One recording for each sequence: the split's part in time, in the HD cameras ``numbers``.

    Frames are those of the 3D files, so that the split is the same for all cameras; detections are matched by
    frame number, and a frame without them is not seen. Of several bodies, the truth is the id that is there in most
    of the split's frames. Raises GhptDataError if a file is missing, damaged or not what it should be.
    """
    check(split in SPLITS, "split", f"is {split!r}", f"Existing: {', '.join(SPLITS)}.")
    for folder in _sequences(root):
        scenes = _scenes(folder)
        start, end = (int(part * len(scenes)) for part in SPLITS[split])
        frame = np.array(list(scenes)[start:end], dtype=np.int64)
        truth, truth_seen = _truth([scenes[number] for number in frame])
        names, cameras, distortion = _cameras(folder, numbers)
        shape = (len(frame), len(numbers), len(JOINT))
        key_points, seen = np.zeros((*shape, 2), np.float32), np.zeros(shape, np.bool_)
        confidence = np.zeros(shape, np.float32)
        for view, detections in enumerate(_detections(folder, numbers, list(scenes))):
            found, place = _match(frame, detections["frame"])
            confidence[found, view] = detections["confidence"][place]
            key_points[found, view], seen[found, view] = undistorted(
                detections["key_points"][place], detections["seen"][place], cameras.K[view].numpy(), distortion[view]
            )
        yield Recording(
            name=folder.name, subject=folder.name, action=_action(folder.name), rate_hz=_RATE_HZ,
            camera_names=names, cameras=cameras, key_points=key_points,
            confidence=np.where(seen, confidence, 0).astype(np.float32), seen=seen,
            truth=truth, truth_seen=truth_seen, frame=frame,
        )  # fmt: skip


def joints17(
    joints19: Float[np.ndarray, "T 19 3"], there: Bool[np.ndarray, "T 19"]
) -> tuple[Float[np.ndarray, "T 17 3"], Bool[np.ndarray, "T 17"]]:
    """COCO19 as the 17 joints, by name. A mean (spine, head top) is there if all of its joints are."""
    parts = [[COCO19.index(name) for name in _PARTS[joint]] for joint in JOINT]
    points = np.stack([joints19[:, part].mean(1) for part in parts], axis=1)
    seen = np.stack([there[:, part].all(1) for part in parts], axis=1)
    return np.where(seen[..., None], points, 0).astype(np.float32), seen


def _sequences(root: Path) -> list[Path]:
    folders = sorted(root.iterdir()) if root.is_dir() else []
    sequences = [folder for folder in folders if _calibration(folder).is_file()]
    if not sequences:
        problem = "there is no <seq>/calibration_<seq>.json below"
        raise GhptDataError(root, "", problem, "data.root must be the folder that holds the sequences' folders.")
    return sequences


def _calibration(folder: Path) -> Path:
    return folder / f"calibration_{folder.name}.json"


def _scenes(folder: Path) -> dict[int, Path]:
    """Frame number -> 3D file, in order of time."""
    files = (folder / _SCENES).iterdir() if (folder / _SCENES).is_dir() else ()
    scenes = {int(m[1]): f for f in files if (m := re.fullmatch(r"body3DScene_(\d{1,12})\.json", f.name))}
    if not scenes:
        raise GhptDataError(folder / _SCENES, "", "there is no body3DScene_<frame>.json", _GET)
    return dict(sorted(scenes.items()))


def _action(name: str) -> str:
    """``171026_pose3`` -> ``pose``."""
    return name.partition("_")[2].rstrip("0123456789") or "unknown"


def _cameras(folder: Path, numbers: Sequence[int]) -> tuple[tuple[str, ...], Cameras, Float[np.ndarray, "V 5"]]:
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
    names = tuple(_name(number) for number in numbers)
    check_names(path, names, list(by_name))
    values = {
        field: np.stack([_numbers(path, name, by_name[name], field, shape) for name in names])
        for field, shape in {"K": (3, 3), "R": (3, 3), "t": (3, 1), "distCoef": (5,)}.items()
    }
    t = values["t"][..., 0] * _MM
    cameras, distortion = check_cameras(path, names, values["K"], values["R"], t, values["distCoef"])
    return names, cameras, distortion


def _name(number: int) -> str:
    return f"00_{number:02d}"


def _numbers(path: Path, where: str, entry: dict[str, Any], field: str, shape: tuple[int, ...]) -> np.ndarray:
    try:
        array = np.array(entry[field])
    except KeyError as error:
        raise GhptDataError(path, f"{where}, {field}", "is missing", _GET) from error
    except (ValueError, OverflowError) as error:
        raise GhptDataError(path, f"{where}, {field}", "is not an array of numbers", _GET) from error
    return check_array(path, f"{where}, {field}", array, shape, "fiu").astype(np.float64)


def _truth(files: Sequence[Path]) -> tuple[Float[np.ndarray, "T 17 3"], Bool[np.ndarray, "T 17"]]:
    """The poses (mm) of the body that is there in most files; where it is not, no joint is seen."""
    scenes = [_bodies(file) for file in files]
    counts = Counter(body for scene in scenes for body in scene)
    person = min(counts, key=lambda body: (-counts[body], body), default=0)
    nobody = np.full((len(COCO19), 4), -1.0)
    joints = np.stack([scene.get(person, nobody) for scene in scenes]) if scenes else np.empty((0, *nobody.shape))
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
            raise GhptDataError(path, "id", f"is {number!r}: not a whole number, or there twice", _GET)
        found[number] = _numbers(path, f"body {number}", body, "joints19", (4 * len(COCO19),)).reshape(-1, 4)
        if not (np.abs(found[number]) < 1e6).all():
            raise GhptDataError(path, f"body {number}, joints19", "is not finite, or beyond 10 km", _GET)
    return found


def _detection_files(folder: Path, numbers: Sequence[int]) -> list[Path]:
    """Of this sequence: one file per camera, or the authors' array with what lies beside it."""
    files = [folder / "keypoints" / f"{_name(number)}.npz" for number in numbers]
    if (folder / "keypoints").is_dir():
        for file in files:
            if not file.is_file():
                raise GhptDataError(file, "", "there is no such file", "Each camera of the arrangement needs one.")
        return files
    if (folder / "all_2d_preds.npy").is_file():
        names = ("all_2d_preds.npy", "all_bboxes.npy", "all_frames.npy", "all_cameras.json")
        return [folder / name for name in names if (folder / name).is_file()]
    problem = "there are neither keypoints/00_<camera>.npz nor all_2d_preds.npy"
    raise GhptDataError(folder, "", problem, "Run a 2D detector on the HD videos and put its key points there.")


def _detections(folder: Path, numbers: Sequence[int], frames: list[int]) -> Iterator[dict[str, np.ndarray]]:
    """For each camera: frame [N], key_points [N 17 2] in raw pixels, confidence [N 17], seen [N 17]."""
    files = _detection_files(folder, numbers)
    if files[0].name == "all_2d_preds.npy":
        yield from _authors_detections(folder, numbers, frames)
        return
    joints = len(JOINT)
    fields = {"frame": ((None,), "iu"), "key_points": ((None, joints, 2), "f"),
              "confidence": ((None, joints), "f"), "seen": ((None, joints), "b")}  # fmt: skip
    for file in files:
        arrays = read_npz(file, fields)
        for field, array in arrays.items():
            check_array(file, field, array, (len(arrays["frame"]), *fields[field][0][1:]), fields[field][1])
        confidence = arrays["confidence"]
        bad = arrays["seen"] & ~((confidence >= 0) & (confidence <= 1))
        if bad.any():
            raise GhptDataError(file, "confidence", "is not between 0 and 1", "Scale it.")
        yield arrays


def _authors_detections(folder: Path, numbers: Sequence[int], frames: list[int]) -> Iterator[dict[str, np.ndarray]]:
    path = folder / "all_2d_preds.npy"
    names = [_name(number) for number in range(_HD_CAMERAS)]
    if (folder / "all_cameras.json").is_file():
        names = read_json(folder / "all_cameras.json")
        if not isinstance(names, list):
            raise GhptDataError(folder / "all_cameras.json", "", "is not a list", 'Write ["00_03", "00_06", ...].')
    wanted = [_name(number) for number in numbers]
    check_names(path, wanted, names)
    predictions = read_npy(path, (None, len(names), len(JOINT), 2), "f")
    if (folder / "all_frames.npy").is_file():
        frame = read_npy(folder / "all_frames.npy", (len(predictions),), "iu")
    elif len(predictions) == len(frames):
        frame = np.array(frames)
    else:
        problem = f"has {len(predictions)} frames, and there are {len(frames)} body3DScene files"
        raise GhptDataError(path, "", problem, "Put the frame numbers beside it, as all_frames.npy.")
    boxes = None
    if (folder / "all_bboxes.npy").is_file():
        boxes = read_npy(folder / "all_bboxes.npy", (len(predictions), len(names), 2, 2), "fiu")
    for name in wanted:
        view = slice(names.index(name), names.index(name) + 1)
        pixels = predictions[:, view].astype(np.float64)
        there = np.ones(pixels.shape[:-1], np.bool_)
        if boxes is not None:
            pixels, there = in_image(pixels, boxes[:, view].astype(np.float64))
        yield {"frame": frame, "key_points": pixels[:, 0], "seen": there[:, 0],
               "confidence": np.ones(there.shape[::2], np.float32)}  # fmt: skip


def _match(
    frame: Int[np.ndarray, " T"], detected: Int[np.ndarray, " N"]
) -> tuple[Int[np.ndarray, " M"], Int[np.ndarray, " M"]]:
    """Places in ``frame`` and in ``detected`` of the frame numbers that are in both."""
    _, here, there = np.intersect1d(frame, detected, return_indices=True)
    return here, there
