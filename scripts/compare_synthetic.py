"""Compare the synthetic motion and detector with real ones: the tables of docs/synthetic.md.

    python scripts/compare_synthetic.py [--shared ../shared/data]

Only summary numbers of the real recordings are derived; nothing of them is copied.
"""

from __future__ import annotations

import argparse
import csv
import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
import yaml
from scipy.spatial.transform import Rotation
from scipy.stats import spearmanr

from ghpt.data.datasets.panoptic_joints import joints17
from ghpt.data.synthetic.detector import Detector
from ghpt.data.synthetic.recordings import synthetic_recordings, takes
from ghpt.geometry import lens
from ghpt.geometry.cameras import Cameras, project
from ghpt.models.estimators.classical import MEstimator
from ghpt.observations import Observations
from ghpt.skeleton import BONES, JOINT, JOINTS, PELVIS, THORAX

ROOT = Path(__file__).resolve().parents[1]
COMMON = (
    "nose",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
    "left_hip",
    "right_hip",
    "left_knee",
    "right_knee",
    "left_ankle",
    "right_ankle",
)
"""The joints that every detector has."""
COCO = (0, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16)
MEDIAPIPE = (0, 11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28)
UPPER_ARM = 0.172
"""In statures, as in ghpt.data.synthetic.body."""


@dataclass(frozen=True)
class Motion:
    """Clips of 3D joints, mm, and which way is up."""

    rate_hz: float
    clips: list[np.ndarray]
    up: np.ndarray


@dataclass(frozen=True)
class Detected:
    """Clips of detections (T V J 2), confidences and masks of the common joints, undistorted."""

    rate_hz: float
    cameras: Cameras
    clips: list[tuple[np.ndarray, np.ndarray, np.ndarray]]
    confident: bool


def cmu_mocap(shared: Path) -> Motion:
    with np.load(shared / "cmu_mocap/cmu_mocap_17_joints_60hz.npz") as data:
        joints = data["joints_mm"].astype(float)
        starts = data["clip_start"]
        rate = float(data["rate_hz"])
    clips = [joints[a:b] for a, b in pairwise(starts)]
    return Motion(rate, clips, np.array([0.0, 0.0, 1.0]))


def range_of_motion(shared: Path) -> Motion:
    """Return the 17 joints of COCO19; frames with a missing joint are left out."""
    with np.load(shared / "panoptic/171026_pose3_joints19.npz") as data:
        poses = data["poses"] * 10.0
    valid = ~(poses == 0).all(axis=-1)
    whole = valid.all(axis=-1)
    joints, _ = joints17(poses, valid)
    cuts = np.flatnonzero(np.diff(whole.astype(int))) + 1
    clips = []
    for clip, complete in zip(np.split(joints, cuts), np.split(whole, cuts), strict=True):
        if complete[0] and len(clip) > 30:
            clips.append(clip.astype(float))
    return Motion(30.0, clips, np.array([0.0, -1.0, 0.0]))


def synthetic_motion(data: str) -> Motion:
    up = np.array([0.0, 0.0, 1.0] if data == "h36m" else [0.0, -1.0, 0.0])
    every = list(takes(data, "test", 0))
    return Motion(every[0].rate_hz, [take.truth for take in every], up)


def pose2sim(shared: Path) -> Detected:
    """OpenPose BODY_25B; in each view the person who is largest."""
    folder = shared / "pose2sim_single"
    table = tomllib.loads((folder / "Calib_qualisys.toml").read_text())
    entries = [entry for name, entry in table.items() if name != "metadata"]
    rotations = Rotation.from_rotvec([entry["rotation"] for entry in entries]).as_matrix()
    views = []
    for view in range(len(entries)):
        frames = []
        for file in sorted((folder / f"pose/cam{view + 1}_json").glob("*.json")):
            people = [
                np.reshape(p["pose_keypoints_2d"], (-1, 3))
                for p in json.loads(file.read_text())["people"]
            ]
            frames.append(
                max(people, key=lambda person: np.ptp(person[person[:, 2] > 0, 1]))[list(COCO)]
            )
        views.append(frames)
    raw = np.array(views).swapaxes(0, 1)
    return _undistort(entries, rotations, raw[..., :2], raw[..., 2], raw[..., 2] > 0, 60.0, True)


def caliscope(shared: Path) -> Detected:
    """MediaPipe; a key point outside the image counts as not seen."""
    table = tomllib.loads((shared / "caliscope/camera_array.toml").read_text())["cameras"]
    entries = [table[name] for name in sorted(table, key=int)]
    with open(shared / "caliscope/xy_HOLISTIC.csv", encoding="utf-8", newline="") as handle:
        lines = [line for line in csv.DictReader(handle) if int(line["point_id"]) in MEDIAPIPE]
    frames = {
        number: index
        for index, number in enumerate(sorted({int(line["sync_index"]) for line in lines}))
    }
    raw = np.full((len(frames), len(entries), len(COMMON), 2), np.nan)
    for line in lines:
        at = (
            frames[int(line["sync_index"])],
            int(line["port"]),
            MEDIAPIPE.index(int(line["point_id"])),
        )
        raw[at] = float(line["img_loc_x"]), float(line["img_loc_y"])
    sizes = np.array([entry["size"] for entry in entries])[:, None]
    valid = ((raw >= 0) & (raw <= sizes - 1)).all(axis=-1)
    rotations = np.array([entry["rotation"] for entry in entries])
    return _undistort(
        entries, rotations, np.nan_to_num(raw), np.ones(valid.shape), valid, 30.0, False
    )


def _undistort(
    entries: list[Mapping[str, list]],
    rotations: np.ndarray,
    raw: np.ndarray,
    confidence: np.ndarray,
    valid: np.ndarray,
    rate_hz: float,
    confident: bool,
) -> Detected:
    K, t, distortion = (
        torch.tensor([entry[f] for entry in entries]).double()
        for f in ("matrix", "translation", "distortions")
    )
    pixels = torch.from_numpy(raw).transpose(0, 1)
    undone, exists = lens.undistort(pixels.flatten(1, 2), K, distortion)
    undone, exists = (
        x.unflatten(1, pixels.shape[1:3]).transpose(0, 1).numpy() for x in (undone, exists)
    )
    cameras = Cameras(K, torch.from_numpy(rotations), 1000.0 * t)
    return Detected(rate_hz, cameras, [(undone, confidence, valid & exists)], confident)


def synthetic_detections(data: str) -> Detected:
    config = "human36m" if data == "h36m" else "panoptic"
    detector = Detector(**yaml.safe_load((ROOT / f"conf/detector/{config}.yaml").read_text()))
    columns = [JOINT[name] for name in COMMON]
    recordings = list(synthetic_recordings(data, "test", 0, detector))
    first = recordings[0]
    if data == "h36m":
        recordings = [r for r in recordings[::4] if r.subject == first.subject]
    clips = []
    for recording in recordings:
        arrays = (recording.key_points, recording.confidence, recording.valid)
        clips.append(tuple(array[:, :, columns] for array in arrays))
    return Detected(first.rate_hz, first.cameras, clips, True)


def bend(joints: np.ndarray, side: str, chain: str) -> np.ndarray:
    """Angle between two segments, degrees; 0 is straight."""
    a, b, c = (joints[:, JOINT[f"{side}_{name}"]] for name in chain.split())
    return _angle(b - a, c - b)


def _angle(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    cosine = (u * v).sum(axis=-1) / np.linalg.norm(u, axis=-1) / np.linalg.norm(v, axis=-1)
    return np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))


def motion_rows(motion: Motion) -> dict[str, str]:
    """Lengths in legs, angles (1, 50, 99 %), speeds (50, 90, 99 %)."""
    joints = np.concatenate(motion.clips)
    length = {
        (JOINTS[a], JOINTS[b]): np.linalg.norm(joints[:, a] - joints[:, b], axis=-1).mean()
        for a, b in BONES
    }
    leg = length["right_ankle", "right_knee"] + length["right_knee", "right_hip"]
    rows = {"leg (thigh + shank), mm": f"{leg:.0f}"}
    for (a, b), value in length.items():
        if "left" not in a + b:
            rows[f"{a} - {b}, legs".replace("right_", "")] = f"{value / leg:.2f}"
    both = lambda chain: np.concatenate([bend(joints, side, chain) for side in ("right", "left")])  # noqa: E731
    trunk = joints[:, THORAX] - joints[:, PELVIS]
    angles = {
        "elbow flexion": both("shoulder elbow wrist"),
        "knee flexion": both("hip knee ankle"),
        "trunk from upright": _angle(trunk, np.broadcast_to(motion.up, trunk.shape)),
    }
    for name, values in angles.items():
        rows[f"{name}, deg"] = _percentiles(values, (1, 50, 99), 0)
    speed = [
        np.linalg.norm(np.diff(clip, axis=0), axis=-1) * motion.rate_hz / 1000
        for clip in motion.clips
    ]
    for name in ("pelvis", "head_top", "left_elbow", "left_wrist", "left_knee", "left_ankle"):
        rows[f"speed of {name.replace('left_', '')}, m/s"] = _percentiles(
            np.concatenate(speed)[:, JOINT[name]], (50, 90, 99), 2
        )
    return rows


def detector_rows(detected: Detected) -> dict[str, str]:
    """Residuals of a robust triangulation from the other views' consensus, relative to the stature
    in the image.
    """
    errors = []
    ranks = []
    seen_share = []
    pairs: dict[float, list[np.ndarray]] = {0.1: [], 0.5: [], 1.0: []}
    for key_points, confidence, valid in detected.clips:
        residual = _residual(detected.cameras, key_points, confidence, valid)
        length = np.linalg.norm(residual, axis=-1)
        errors.append(length[np.isfinite(length)])
        seen_share.append(valid)
        limit = np.nanpercentile(np.abs(residual), 95)
        for seconds, found in pairs.items():
            lag = round(seconds * detected.rate_hz)
            both = np.stack([residual[:-lag].ravel(), residual[lag:].ravel()])
            found.append(both[:, (np.abs(both) < limit).all(axis=0)])
        if detected.confident:
            for joint in range(len(COMMON)):
                there = np.isfinite(length[:, :, joint])
                if there.sum() > 50:
                    ranks.append(
                        spearmanr(
                            length[:, :, joint][there], -confidence[:, :, joint][there]
                        ).statistic
                    )
    rows = {
        "residual, % of the stature (50, 90, 99 %)": _percentiles(
            100 * np.concatenate(errors), (50, 90, 99), 2
        )
    }
    for seconds, found in pairs.items():
        rows[f"its autocorrelation after {seconds} s"] = (
            f"{np.corrcoef(np.concatenate(found, axis=1))[0, 1]:.2f}"
        )
    rows["rank correlation with -confidence"] = f"{np.mean(ranks):.2f}" if ranks else "-"
    rows["key points not seen"] = f"{100 * (1 - np.mean(np.concatenate(seen_share))):.1f} %"
    return rows


def _residual(
    cameras: Cameras, key_points: np.ndarray, confidence: np.ndarray, valid: np.ndarray
) -> np.ndarray:
    """T V J 2 in statures; NaN where not seen or seen in fewer than 3 views."""
    frames = len(key_points)
    batch = Observations(
        index=torch.arange(frames),
        recording=torch.zeros(frames, dtype=torch.int64),
        cameras=cameras.expand(frames),
        key_points=torch.from_numpy(key_points),
        confidence=torch.from_numpy(confidence),
        valid=torch.from_numpy(valid),
    )
    points = MEstimator(loss="geman_mcclure", scale=0.01, iterations=50, tolerance=0.1)(
        batch
    ).points.double()
    pixels, depth = project(cameras, points)
    arm = [
        (points[:, COMMON.index(f"{s}_elbow")] - points[:, COMMON.index(f"{s}_shoulder")]).norm(
            dim=-1
        )
        for s in ("left", "right")
    ]
    stature = float(torch.cat(arm).median()) / UPPER_ARM
    shoulders = depth[:, :, [COMMON.index("left_shoulder"), COMMON.index("right_shoulder")]].mean(
        dim=-1
    )
    focal = (cameras.K[:, 0, 0] * cameras.K[:, 1, 1]).sqrt()
    size = (focal * stature / shoulders).numpy()[..., None, None]
    residual = (key_points - pixels.numpy()) / size
    return np.where((valid & (valid.sum(axis=1, keepdims=True) >= 3))[..., None], residual, np.nan)


def _percentiles(values: np.ndarray, at: tuple[int, ...], digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in np.percentile(values, at))


def markdown(columns: Mapping[str, Mapping[str, str]]) -> str:
    names = list(columns)
    lines = ["| | " + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
    lines += [
        f"| {row} | " + " | ".join(columns[n][row] for n in names) + " |"
        for row in columns[names[0]]
    ]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--shared", type=Path, default=ROOT.parent / "shared" / "data", help="the real recordings"
    )
    shared = parser.parse_args().shared
    if not shared.is_dir():
        print(f"{shared} is not there: nothing to compare with.")
        return
    motions = {
        "CMU mocap": cmu_mocap(shared),
        "Panoptic 171026_pose3": range_of_motion(shared),
        "synthetic h36m": synthetic_motion("h36m"),
        "synthetic panoptic": synthetic_motion("cmu3"),
    }
    print(markdown({name: motion_rows(motion) for name, motion in motions.items()}), end="\n\n")
    detections = {
        "OpenPose (pose2sim_single)": pose2sim(shared),
        "MediaPipe (caliscope)": caliscope(shared),
        "synthetic h36m": synthetic_detections("h36m"),
        "synthetic cmu3": synthetic_detections("cmu3"),
    }
    print(markdown({name: detector_rows(detected) for name, detected in detections.items()}))


if __name__ == "__main__":
    main()
