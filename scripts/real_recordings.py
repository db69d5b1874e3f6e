"""Real recordings without a truth: errors in left-out views, constancy of lengths, agreement with
the tools' own 3D.

    python scripts/real_recordings.py FOLDER [ckpt=...]

FOLDER holds pose2sim_single/ (Pose2Sim's demo: pose/, Calib_qualisys.toml, Balancing_for_IK.trc)
and caliscope/ (xy_HOLISTIC.csv, camera_array.toml, xyz_HOLISTIC.csv). Prints Markdown tables. The
tools' own 3D is no truth: it was made of the same key points, by linear triangulation, and
Pose2Sim's was filtered.
"""

from __future__ import annotations

import csv
import sys
import tempfile
from pathlib import Path

import hydra
import numpy as np
import torch

from ghpt.commands.predict import predict
from ghpt.commands.prediction.report import comparison_table
from ghpt.commands.prediction.result import PredictionResult
from ghpt.commands.prediction.settings import PredictSettings
from ghpt.config import plain, settings
from ghpt.data.formats.skeletons import SKELETONS
from ghpt.export import read_reconstruction
from ghpt.report.document import Document, Heading, Table
from ghpt.report.markdown import render_markdown
from ghpt.skeleton import JOINT

ROOT = Path(__file__).resolve().parents[1]
ESTIMATORS = ("linear", "weighted_linear", "ransac", "adaptive_ransac", "m_estimator", "lo_ransac")
LIMBS = [
    f"{side}_{joint}"
    for side in ("right", "left")
    for joint in ("ankle", "knee", "hip", "shoulder", "elbow", "wrist")
]


def main(folder: Path, words: list[str]) -> None:
    recordings = {
        "Pose2Sim's demo": (
            [
                "rate_hz=60",
                "keypoints={}/pose2sim_single/pose",
                "cameras={}/pose2sim_single/Calib_qualisys.toml",
            ],
            of_pose2sim,
        ),
        "caliscope's": (
            [
                "rate_hz=30",
                "keypoints={}/caliscope/xy_HOLISTIC.csv",
                "cameras={}/caliscope/camera_array.toml",
            ],
            of_caliscope,
        ),
    }
    for name, (given, own) in recordings.items():
        theirs = own(folder)
        given = [word.format(folder) for word in given]
        found = {}
        with tempfile.TemporaryDirectory() as output:
            runs = {estimator: [f"estimator={estimator}"] for estimator in ESTIMATORS}
            runs |= {"weight": words} if words else {}
            for estimator, more in runs.items():
                found[estimator] = poses(
                    [*given, *more, "formats=[npz]", "evaluated_frames=1"], Path(output)
                )
            result = run([*given, *words, f"compare=[{','.join(ESTIMATORS)}]"], Path(output))
        rows = [[e, *(f"{value:.1f}" for value in distance(found[e], theirs))] for e in found]
        distances = Table(["distance from the tool's own 3D, mm", "median", "90 %"], rows)
        heading = Heading(f"{name}, {result.coverage.frames} frames")
        print(render_markdown(Document("", [heading, comparison_table(result), distances])))


def run(words: list[str], output: Path) -> PredictionResult:
    with hydra.initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        config = plain(hydra.compose("predict", overrides=["progress_bar=false", *words]))
    return predict(settings(PredictSettings, config | {"output": str(output)}), output)


def poses(words: list[str], output: Path) -> dict[int, np.ndarray]:
    """Frame number -> the twelve limb joints, mm, NaN where missing."""
    run(words, output)
    at = [JOINT[name] for name in LIMBS]
    found = {}
    for part in read_reconstruction(output / "poses.npz")[1]:
        values = (
            torch.where(part.has_position[..., None], part.points, torch.nan)[:, at]
            .double()
            .numpy()
        )
        found |= dict(zip(part.frame.tolist(), values, strict=True))
    return found


def distance(ours: dict[int, np.ndarray], theirs: dict[int, np.ndarray]) -> tuple[float, float]:
    """Median and 90 % over the joints that both have."""
    common = sorted(ours.keys() & theirs.keys())
    apart = np.concatenate([np.linalg.norm(ours[f] - theirs[f], axis=-1) for f in common])
    apart = apart[np.isfinite(apart)]
    return float(np.median(apart)), float(np.quantile(apart, 0.9))


def of_pose2sim(folder: Path) -> dict[int, np.ndarray]:
    """Metres, counted from 1, and turned to y up: x, y, z of the cameras' world are the file's z,
    x, y.
    """
    with open(folder / "pose2sim_single" / "Balancing_for_IK.trc", encoding="utf-8") as handle:
        rows = list(csv.reader(handle, delimiter="\t"))
    names = [name for name in rows[3][2:] if name]
    at = [
        names.index("".join((name[0].upper(), name.split("_")[1].capitalize()))) for name in LIMBS
    ]
    found = {}
    for row in (row for row in rows[5:] if row and row[0].strip()):
        values = np.array([float(cell or "nan") for cell in row[2 : 2 + 3 * len(names)]]).reshape(
            -1, 3
        )
        found[int(row[0]) - 1] = 1000 * values[at][:, [2, 0, 1]]
    return found


def of_caliscope(folder: Path) -> dict[int, np.ndarray]:
    """Metres, in the cameras' world."""
    at = {SKELETONS["mediapipe_33"].index(name): place for place, name in enumerate(LIMBS)}
    found: dict[int, np.ndarray] = {}
    with open(folder / "caliscope" / "xyz_HOLISTIC.csv", encoding="utf-8") as handle:
        for row in csv.DictReader(handle):
            if int(row["point_id"]) in at:
                pose = found.setdefault(int(row["sync_index"]), np.full((len(LIMBS), 3), np.nan))
                pose[at[int(row["point_id"])]] = [
                    1000 * float(row[f"{axis}_coord"]) for axis in "xyz"
                ]
    return found


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), sys.argv[2:])
