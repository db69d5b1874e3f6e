"""Whether the trajectory damps fast motion: clip by clip, before Human3.6M's rig.

    python benchmarks/fast_motion.py MOTION [MOTION ...] [--clips jump] [--frames 160] [--no-online]

MOTION is a file of [N 17 3] in mm with ``clip_start``, ``clip_name`` and ``rate_hz``, or a folder
with the motions of the `pybullet` wheel (``pybullet_data/data/motions/*.txt``) and its
``humanoid.urdf``. Prints a Markdown table: pelvis-relative MPJPE (mm) of adaptive RANSAC, of the
trajectory and of its online form, and by how much the peak speed of the wrists differs from the
truth's, %; then the worst of each.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
import trajectory as whole_benchmark
from jaxtyping import Float
from omegaconf import OmegaConf
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp
from trajectory import Recorded, recorded

from ghpt.api import default_settings
from ghpt.commands.prediction.estimator import build_estimator
from ghpt.config import CONF, build
from ghpt.data.synthetic.detector import Detector
from ghpt.data.synthetic.recordings import Take, takes
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.models.estimators.predictors import remove_outliers
from ghpt.models.estimators.trajectory.windows import Clock
from ghpt.observations import PoseEstimate
from ghpt.skeleton import JOINT, JOINTS, PELVIS

LEAST = 40
"""Frames of a clip."""
RATE_HZ = 60.0
"""To which the motions of pybullet are interpolated."""
WRISTS = [JOINT["left_wrist"], JOINT["right_wrist"]]
Motion = tuple[str, float, Float[np.ndarray, "T 17 3"]]
"""Name, frames per second, mm with z up."""

CHAIN = (
    ("chest", "root", 4),
    ("neck", "chest", 4),
    ("right_hip", "root", 4),
    ("right_knee", "right_hip", 1),
    ("right_ankle", "right_knee", 4),
    ("right_shoulder", "chest", 4),
    ("right_elbow", "right_shoulder", 1),
    ("left_hip", "root", 4),
    ("left_knee", "left_hip", 1),
    ("left_ankle", "left_knee", 4),
    ("left_shoulder", "chest", 4),
    ("left_elbow", "left_shoulder", 1),
)
"""The joints of pybullet's humanoid in the order of a frame, their parents, and how many numbers
each has: a quaternion (w x y z), or an angle about z."""
URDF_MM = 250.0
"""The humanoid's file is four times as large as the person."""
HEAD = {"head_top": (0.0, 250.0, 0.0), "nose": (100.0, 130.0, 0.0)}
"""mm from the neck."""


def clips_of_file(path: Path) -> Iterator[Motion]:
    """Yield the clips of a file of poses."""
    with np.load(path, allow_pickle=False) as file:
        order = [file["joint_name"].tolist().index(joint) for joint in JOINTS]
        poses = next(file[name] for name in file.files if file[name].ndim == 3)[:, order]
        starts = [*file["clip_start"].tolist(), len(poses)][: len(file["clip_name"]) + 1]
        names = file["clip_name"].tolist()
        rate = float(file["rate_hz"])
    for name, (start, end) in zip(names, pairwise(starts), strict=True):
        yield name, rate, poses[start:end].astype(np.float64)


def humanoid_motions(folder: Path) -> Iterator[Motion]:
    """Yield the motions of pybullet's humanoid, by forward kinematics."""
    text = (folder / "humanoid.urdf").read_text(encoding="utf-8", errors="replace")
    offsets = {}
    for name, body in re.findall(r'<joint\s+name\s*=\s*"(\w+)"(.*?)</joint>', text, re.S):
        numbers = re.search(r'xyz\s*=\s*"([^"]+)"', body)
        if numbers:
            offsets[name] = URDF_MM * np.array(numbers[1].split(), float)
    for path in sorted(folder.glob("*.txt")):
        values = np.array(json.loads(path.read_text(encoding="utf-8"))["Frames"])
        if values.shape[1] == 8 + sum(size for _, _, size in CHAIN):
            yield path.stem, RATE_HZ, humanoid_poses(values, offsets)


def humanoid_poses(
    values: Float[np.ndarray, "N 44"], offsets: dict[str, Float[np.ndarray, " 3"]]
) -> Float[np.ndarray, "T 17 3"]:
    """Return the poses of key frames, at `RATE_HZ`."""
    key_time = np.concatenate([[0], np.cumsum(values[:-1, 0])])
    time = np.arange(0, key_time[-1], 1 / RATE_HZ)

    def turn(numbers: Float[np.ndarray, "N k"]) -> Rotation:
        if numbers.shape[1] == 1:
            angle = np.interp(time, key_time, numbers[:, 0])
            return Rotation.from_euler("z", angle[:, None])
        keys = Rotation.from_quat(numbers[:, [1, 2, 3, 0]])
        return Slerp(key_time, keys)(time)

    place = {"root": 1000 * CubicSpline(key_time, values[:, 1:4])(time)}
    turned = {"root": turn(values[:, 4:8])}
    column = 8
    for name, parent, size in CHAIN:
        place[name] = place[parent] + turned[parent].apply(offsets[name])
        turned[name] = turned[parent] * turn(values[:, column : column + size])
        column += size
    for side in ("left", "right"):
        elbow = f"{side}_elbow"
        place[f"{side}_wrist"] = place[elbow] + turned[elbow].apply(offsets[f"{side}_wrist"])
    for name, offset in HEAD.items():
        place[name] = place["neck"] + turned["neck"].apply(offset)
    place["thorax"] = place["neck"]
    place["pelvis"] = place["root"]
    place["spine"] = (place["root"] + place["neck"]) / 2
    x, y, z = np.moveaxis(np.stack([place[name] for name in JOINTS], 1), -1, 0)
    return np.stack([x, -z, y], -1)


def in_the_room(motion: Motion) -> Take:
    """Return a motion where the validation subject stands."""
    name, rate, poses = motion
    room = next(iter(takes("h36m", "validation", 0))).truth.mean((0, 1))
    truth = poses.copy()
    truth[..., :2] += room[:2] - truth[..., :2].mean((0, 1))
    truth[..., 2] -= truth[..., 2].min() - 20
    return Take(name, name, "motion", rate, human36m_rig("S8"), truth, False, 0)


def peak_speed(points: Float[torch.Tensor, "T 17 3"], rate_hz: float) -> float:
    """Return the largest speed of the wrists over two frames, m/s."""
    steps = (points[2:, WRISTS] - points[:-2, WRISTS]).norm(dim=-1) / 2
    return float(steps.max()) * rate_hz / 1000


def mpjpe(found: PoseEstimate, one: Recorded) -> float:
    points = found.points.double()
    estimated = found.estimated & found.estimated[:, PELVIS, None]
    offset = (points - points[:, PELVIS, None]) - (one.truth - one.truth[:, PELVIS, None])
    return float(offset.norm(dim=-1)[estimated].mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("motion", type=Path, nargs="+")
    parser.add_argument("--clips", default="", help="a regular expression")
    parser.add_argument("--frames", type=int, default=160, help="of a clip, from its middle")
    parser.add_argument("--no-online", action="store_true")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    whole_benchmark.FRAMES = arguments.frames
    values = OmegaConf.to_container(OmegaConf.load(CONF / "detector/human36m.yaml"))
    detector = Detector(**values)
    settings = default_settings()
    frame = build(settings.baselines["adaptive_ransac"], "baselines")
    trajectory = build_estimator(settings).predictor.trajectory
    online = build_estimator(default_settings(estimator="online")).predictor
    print("| clip | frames | peak, m/s | RANSAC | trajectory | peak % | online | peak % |")
    print("|---|---|---|---|---|---|---|---|")
    rows = []
    for path in arguments.motion:
        motions = humanoid_motions(path) if path.is_dir() else clips_of_file(path)
        for motion in motions:
            if len(motion[2]) < LEAST or not re.search(arguments.clips, motion[0]):
                continue
            one = recorded(in_the_room(motion), detector)
            batch, _ = remove_outliers(one.observations)
            found = {"RANSAC": frame(batch)}
            fitted = trajectory.at_rate(batch, one.rate_hz).fit_to(batch)
            found["trajectory"] = fitted.complete(batch)
            if not arguments.no_online:
                longest = trajectory.longest_gap_s
                clock = Clock.of_frames(batch.index.numpy(), one.rate_hz, longest)
                found["online"] = replace(online, clock=clock).estimate(batch)
            peak = peak_speed(one.truth, one.rate_hz)
            errors = {name: mpjpe(estimate, one) for name, estimate in found.items()}
            row = [errors["RANSAC"]]
            for name in list(found)[1:]:
                ratio = peak_speed(found[name].points.double(), one.rate_hz) / peak
                row += [errors[name], 100 * (ratio - 1)]
            rows.append(row)
            cells = " | ".join(f"{value:.1f}" for value in row)
            print(f"| {motion[0]} | {len(batch)} | {peak:.1f} | {cells} |", flush=True)
    table = np.array(rows)
    print(f"\nmean of {len(table)} clips:", np.round(table.mean(0), 2).tolist())
    for number, name in enumerate(("trajectory", "online")[: (table.shape[1] - 1) // 2]):
        behind = table[:, 1 + 2 * number] - table[:, 0]
        peaks = table[:, 2 + 2 * number]
        worst = f"at most {behind.max():.2f} mm behind RANSAC"
        far = (np.abs(peaks) > 3).sum()
        print(f"{name}: {worst}, {(behind > 0.5).sum()} clips by more than 0.5;", end=" ")
        print(f"peaks {peaks.min():.1f} to {peaks.max():.1f} %, {far} beyond 3 %")


if __name__ == "__main__":
    main()
