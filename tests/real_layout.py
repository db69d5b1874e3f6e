"""Folders in the layouts of the real data sets, made from poses: test support, and what
scripts/real_motion.py uses.
"""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from ghpt.data.datasets.labels import LABELS_FILE
from ghpt.data.datasets.panoptic_joints import COCO19, joints17
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.geometry.cameras import CameraSet, project
from ghpt.geometry.lens import distort
from ghpt.skeleton import MIRROR

Detect = Callable[[CameraSet, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""(rig, poses [T 17 3] mm) -> ideal pixels [T V 17 2], confidence [T V 17], seen [T V 17]."""

SUBJECTS = ["S1", "S5", "S6", "S7", "S8", "S9", "S11"]


def person(
    rng: np.random.Generator, frames: int, centre: Sequence[float], joints: int = 17
) -> np.ndarray:
    """Points [T J 3] within a metre of ``centre`` (mm)."""
    return rng.uniform(-900, 900, (frames, joints, 3)) + np.asarray(centre, float)


def ideal(rig: CameraSet, poses: np.ndarray) -> np.ndarray:
    """Pinhole pixels [T V J 2]."""
    return project(rig.cameras, torch.from_numpy(poses))[0].numpy()


def through_lens(rig: CameraSet, pixels: np.ndarray) -> np.ndarray:
    """What the real lenses show of ideal pixels [T V J 2]."""
    shown = np.empty_like(pixels)
    for view in range(len(rig)):
        flat = torch.from_numpy(pixels[:, view]).reshape(-1, 2)
        shown[:, view] = (
            distort(flat, rig.cameras.K[view], rig.distortion[view])
            .reshape(pixels[:, view].shape)
            .numpy()
        )
    return shown


def perfect(rig: CameraSet, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A detector without error."""
    pixels = ideal(rig, poses)
    return pixels, np.ones(pixels.shape[:-1]), np.ones(pixels.shape[:-1], bool)


def human36m_labels(takes: Sequence[tuple[str, str, np.ndarray]]) -> dict:
    """karfly's labels of takes (subject, action with number, poses [T 17 3] mm)."""
    actions = sorted({action for _, action, _ in takes})
    rigs = [human36m_rig(subject) for subject in SUBJECTS]
    cameras = np.zeros(
        (7, 4), [("R", "f4", (3, 3)), ("t", "f4", (3, 1)), ("K", "f4", (3, 3)), ("dist", "f4", 5)]
    )
    for row, rig in zip(cameras, rigs, strict=True):
        row["R"], row["K"], row["dist"] = rig.cameras.R, rig.cameras.K, rig.distortion
        row["t"] = rig.cameras.t[..., None]
    columns = [
        ("subject_idx", "i1"),
        ("action_idx", "i1"),
        ("frame_idx", "i2"),
        ("keypoints", "f4", (17, 3)),
        ("bbox_by_camera_tlbr", "i2", (4, 4)),
    ]
    table = np.zeros(sum(len(poses) for *_, poses in takes), columns)
    table["subject_idx"] = np.repeat(
        [SUBJECTS.index(s) for s, *_ in takes], [len(p) for *_, p in takes]
    )
    table["action_idx"] = np.repeat(
        [actions.index(a) for _, a, _ in takes], [len(p) for *_, p in takes]
    )
    table["frame_idx"] = np.concatenate([5 * np.arange(len(p)) for *_, p in takes])
    table["keypoints"] = np.concatenate([p for *_, p in takes])
    return {
        "subject_names": list(SUBJECTS),
        "camera_names": list(rigs[0].names),
        "action_names": actions,
        "cameras": cameras,
        "table": table,
    }


def write_pickle(path: Path, content: object, protocol: int = 4) -> None:
    """``numpy.save`` of a Python object, by a chosen pickle protocol."""
    with open(path, "wb") as handle:
        np.lib.format.write_array_header_1_0(
            handle, {"descr": "|O", "fortran_order": False, "shape": ()}
        )
        box = np.empty((), object)
        box[()] = content
        pickle.dump(box, handle, protocol=protocol)


def write_human36m_layout(
    root: Path, takes: Sequence[tuple[str, str, np.ndarray]], chunk: int
) -> None:
    """Labels, and perfect detections in pixels of a 384-high crop, in chunks of ``chunk``
    frames."""
    root.mkdir(parents=True, exist_ok=True)
    write_pickle(root / LABELS_FILE, human36m_labels(takes))
    for subject in {subject for subject, *_ in takes}:
        poses = np.concatenate([p for s, _, p in takes if s == subject])
        rig = human36m_rig(subject)
        shown = through_lens(rig, ideal(rig, poses))
        corner = np.floor(shown.min(2))
        size = np.ceil((shown.max(2) - corner).max(-1, keepdims=True))
        crop = (shown - corner[:, :, None]) * (384 / size[:, :, None])
        boxes = np.stack([corner, corner + size], axis=2)
        (root / subject).mkdir()
        for number, start in enumerate(range(0, len(poses), chunk)):
            part = slice(start, start + chunk)
            for name, array in (("2d_preds", crop), ("bboxes", boxes), ("3d_gt", poses)):
                np.save(root / subject / f"all_{name}{number}.npy", array[part].astype(np.float32))


def write_panoptic_layout(
    root: Path,
    name: str,
    calibration: dict,
    rig: CameraSet,
    frames: Sequence[int],
    poses: np.ndarray,
    detect: Detect,
) -> None:
    """A sequence: poses [T 19 3] (cm, COCO19; NaN = missing) and detections as
    keypoints/<camera>.npz.
    """
    folder = root / name
    (folder / "hdPose3d_stage1_coco19").mkdir(parents=True)
    (folder / "keypoints").mkdir()
    (folder / f"calibration_{name}.json").write_text(json.dumps(calibration))
    there = np.isfinite(poses).all(-1)
    for frame, points, good in zip(frames, np.nan_to_num(poses), there, strict=True):
        joints = np.column_stack([points, np.where(good, 0.5, -1)])
        body = {"id": 0, "joints19": joints.round(5).ravel().tolist()}
        scene = {"version": 0.7, "univTime": frame * 33.37, "fpsType": "hd_29_97", "bodies": [body]}
        path = folder / "hdPose3d_stage1_coco19" / f"body3DScene_{frame:08d}.json"
        path.write_text(json.dumps(scene))
    body, _ = joints17(np.nan_to_num(poses) * 10, there)
    pixels, confidence, valid = detect(rig, body.astype(np.float64))
    shown = through_lens(rig, pixels.astype(np.float64))
    for view, camera in enumerate(rig.names):
        np.savez(
            folder / "keypoints" / f"{camera}.npz",
            frame=np.asarray(frames),
            key_points=shown[:, view].astype(np.float32),
            confidence=confidence[:, view].astype(np.float32),
            seen=valid[:, view],
        )


def panoptic_calibration(rig: CameraSet) -> dict:
    """The calibration file's content for a rig, in its order."""
    cameras = [
        {
            "name": name,
            "type": "hd",
            "resolution": rig.size[v].tolist(),
            "panel": 0,
            "node": v,
            "K": rig.cameras.K[v].tolist(),
            "distCoef": rig.distortion[v].tolist(),
            "R": rig.cameras.R[v].tolist(),
            "t": (rig.cameras.t[v, :, None] / 10).tolist(),
        }
        for v, name in enumerate(rig.names)
    ]
    return {"calibDataSource": "test", "cameras": cameras}


def cmu_labels(rig: CameraSet, mm: float) -> dict:
    """Labels as the CMU data set's are: cameras of two actions, t in a unit of ``mm``."""
    fields = [("R", "f4", (3, 3)), ("t", "f4", (3, 1)), ("K", "f4", (3, 3)), ("dist", "f4", 5)]
    cameras = np.zeros((2, len(rig)), fields)
    cameras["R"], cameras["K"] = rig.cameras.R, rig.cameras.K
    cameras["t"], cameras["dist"] = rig.cameras.t[..., None] / mm, rig.distortion
    columns = [("action_idx", "i1"), ("person_id", "i1"), ("frame_name", "i2")]
    table = np.zeros(5, [*columns, ("keypoints", "f4", (19, 4))])
    return {
        "camera_names": list(rig.names),
        "action_names": ["171026_pose1", "171026_pose2"],
        "person_ids": [0, 4],
        "cameras": cameras,
        "table": table,
    }


def write_cmu_layout(
    root: Path,
    rig: CameraSet,
    poses: np.ndarray,
    truth_mm: float = 1.0,
    camera_mm: float = 10.0,
    lens: bool = True,
    mirrored: bool = False,
    flat_boxes: bool = False,
) -> np.ndarray:
    """The authors' flat folder of poses [T 19 3] mm; returns the 17 joints that it shows."""
    root.mkdir(parents=True, exist_ok=True)
    joints, _ = joints17(poses, np.isfinite(poses).all(-1))
    shown = ideal(rig, joints.astype(np.float64))
    shown = through_lens(rig, shown) if lens else shown
    corner = np.floor(shown.min(2))
    size = np.ceil((shown.max(2) - corner).max(-1, keepdims=True))
    crop = (shown - corner[:, :, None]) * (384 / size[:, :, None])
    boxes = np.stack([corner, corner + size], axis=2)
    order = list(MIRROR) if mirrored else slice(None)
    np.save(root / "all_2d_preds.npy", crop[:, :, order].astype(np.float32))
    np.save(root / "all_bboxes.npy", boxes.reshape(*boxes.shape[:2], 4) if flat_boxes else boxes)
    np.save(root / "all_3d_gt.npy", (poses / truth_mm).astype(np.float32))
    write_pickle(root / "cmu-multiview-labels-MRCNNbboxes.npy", cmu_labels(rig, camera_mm))
    return joints


def upright19() -> np.ndarray:
    """One standing person [19 3] in Panoptic's world (cm, y down): left joints at x = 20, right
    ones at -20.
    """
    heights = {
        "neck": -140,
        "nose": -155,
        "mid_hip": -95,
        "shoulder": -138,
        "elbow": -115,
        "wrist": -95,
        "hip": -95,
        "knee": -50,
        "ankle": -10,
        "eye": -160,
        "ear": -158,
    }
    sides = {"left": 20.0, "right": -20.0}
    return np.array(
        [
            [
                sides.get(name.split("_")[0], 0.0),
                heights[name.removeprefix("left_").removeprefix("right_")],
                0.0,
            ]
            for name in COCO19
        ]
    )
