"""Fit the synthetic detector *field* to what three real detectors' residuals are like.

    python scripts/fit_field_detector.py            fit, print, write conf/detector/field.yaml
    python scripts/fit_field_detector.py --check    print only, with the numbers that are there

The real sets are OpenPose and BlazePose on Pose2Sim's demo recording and MediaPipe on caliscope's.
Each is triangulated, and the motion that it shows is detected again by the detector model through
the same cameras, with the same key points missing. Both go the same way: the cameras adjusted to
the key points, the joints triangulated, the residuals measured. So what the adjustment hides of a
detector's errors it hides of both. A statistic is the geometric mean over the sets; each free
number has the one that it moves most, and is multiplied by what that one lacks, in turns.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import yaml
from jaxtyping import Bool, Float
from rich.console import Console
from rich.table import Table
from scipy.signal import butter, filtfilt
from scipy.stats import spearmanr

from ghpt.calibration.observations import observe
from ghpt.calibration.resection import PlacedRig
from ghpt.calibration.rig import RigCalibration
from ghpt.config import build
from ghpt.data.formats.camera_files import read_cameras
from ghpt.data.formats.key_points import read_key_points
from ghpt.data.people.persons import person_sequence
from ghpt.data.synthetic.detector import Detector
from ghpt.files import atomic_write
from ghpt.geometry.cameras import Cameras, CameraSet, project
from ghpt.models.estimators.classical import person_scale
from ghpt.models.estimators.flips import LeftRightFlips, undo_flips
from ghpt.models.estimators.ransac import AdaptiveRansac
from ghpt.observations import Observations
from ghpt.skeleton import BONES

CONF = Path(__file__).resolve().parents[1] / "conf"
SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
SEEDS = (0, 1, 2)
TURNS = 4
CUTOFF_HZ = 6.0
RECORDINGS = {
    "OpenPose": ("pose2sim_single/pose", "pose2sim_single/Calib_qualisys.toml", 60.0),
    "BlazePose": ("pose2sim_blazepose/full.npz", "pose2sim_single/Calib_qualisys.toml", 60.0),
    "MediaPipe": ("caliscope/xy_HOLISTIC.csv", "caliscope/camera_array.toml", 30.0),
}
FREE = {
    "noise": "varying",
    "view_bias": "lasting",
    "noise_seconds": "after 1/12 s",
    "neighbours": "neighbours",
    "outlier_rate": "90 %",
    "outlier_size": "99 %",
    "confidence_knowledge": "confidence",
}
"""Which statistic each free number is fitted to."""
LIMITS = {"confidence_knowledge": 0.95, "neighbours": 0.9, "outlier_rate": 0.1}
TIED = {"outlier_rate_occluded": ("outlier_rate", 4.0)}
HELD = {
    "noise_white": 0.05,
    "noise_slow": 0.3,
    "noise_slow_seconds": 0.5,
    "noise_spread": 0.5,
    "view_bias_degrees": 30.0,
    "bias_of_subject": 0.5,
    "swap_seconds": 0.3,
    "swap_together": 0.9,
    "familiar": 1.0,
}
"""Numbers that these short recordings do not tell, or that one statistic cannot tell apart."""


@dataclass(frozen=True)
class Clip:
    """One person's key points before cameras that are roughly known."""

    rate_hz: float
    cameras: CameraSet
    key_points: Float[torch.Tensor, "T V J 2"]
    confidence: Float[torch.Tensor, "T V J"]
    valid: Bool[torch.Tensor, "T V J"]


@dataclass(frozen=True)
class Fitted:
    """A clip with its left-right flips undone and its cameras adjusted to it."""

    clip: Clip
    flipped: Bool[torch.Tensor, "T V"]
    cameras: Cameras
    points: Float[torch.Tensor, "T J 3"]
    estimated: Bool[torch.Tensor, "T J"]


def read(name: str, shared: Path) -> Clip:
    key_points, cameras, rate = RECORDINGS[name]
    people = read_key_points(shared / key_points, None, rate, None)
    known = read_cameras(shared / cameras, None, None)
    sequence = person_sequence(people, known)
    points = sequence.undistorted()
    return Clip(
        rate_hz=rate,
        cameras=sequence.cameras,
        key_points=torch.from_numpy(points.pixels).double(),
        confidence=torch.from_numpy(points.confidence).double(),
        valid=torch.from_numpy(points.valid),
    )


def adjust(clip: Clip, calibration: RigCalibration) -> Fitted:
    clip, flipped = _undo_flips(clip)
    cameras = clip.cameras.cameras
    observed = observe(cameras.K, clip.key_points, clip.valid, calibration.noise)
    unit = float(cameras.centre.std(dim=0).norm())
    rig = PlacedRig(
        R=cameras.R,
        t=cameras.t / unit,
        placed=torch.ones(len(cameras.R), dtype=torch.bool),
        points=torch.zeros(len(observed.frame), 3, dtype=torch.float64),
        inlier=observed.valid,
    )
    for _ in range(2):
        rig = calibration.resection.triangulate(observed, rig, 0)
        rig = calibration.bundle(observed, rig).rig
    shape = (len(clip.valid), clip.valid.shape[2])
    return Fitted(
        clip=clip,
        flipped=flipped,
        cameras=Cameras(cameras.K, rig.R, unit * rig.t),
        points=unit * rig.points.unflatten(0, shape),
        estimated=rig.inlier.any(0).unflatten(0, shape),
    )


def _undo_flips(clip: Clip) -> tuple[Clip, torch.Tensor]:
    frames = len(clip.valid)
    estimator = AdaptiveRansac(threshold=0.02, pairs=24, seed=0, adapt=5.0, quantile=0.55, rounds=4)
    flips = LeftRightFlips(estimator=estimator, scale=0.02, gain=10.0, rounds=3, views=2)
    batch = Observations(
        index=torch.arange(frames),
        recording=torch.zeros(frames, dtype=torch.int64),
        cameras=clip.cameras.cameras.expand(frames),
        key_points=clip.key_points,
        confidence=clip.confidence,
        valid=clip.valid,
    )
    undone, flipped = undo_flips(batch, flips)
    changed = replace(
        clip,
        key_points=undone.key_points,
        confidence=undone.confidence,
        valid=undone.valid,
    )
    return changed, flipped


def motion_of(fitted: Fitted) -> np.ndarray:
    """The joints [T J 3] that a clip shows, gaps filled, slower than 6 Hz."""
    points = fitted.points.numpy().copy()
    known = fitted.estimated.numpy()
    time = np.arange(len(points))
    middle = np.median(points[known], axis=0)
    for joint in range(points.shape[1]):
        own = known[:, joint]
        if not own.any():
            points[:, joint] = middle
            continue
        for axis in range(3):
            points[:, joint, axis] = np.interp(time, time[own], points[own, joint, axis])
    numerator, denominator = butter(2, CUTOFF_HZ, fs=fitted.clip.rate_hz)
    return filtfilt(numerator, denominator, points, axis=0)


def detect_again(fitted: Fitted, motion: np.ndarray, detector: Detector, seed: int) -> Clip:
    """The model's detections of a clip's motion, where the clip has key points."""
    rig = replace(
        fitted.clip.cameras,
        R=fitted.cameras.R,
        t=fitted.cameras.t,
        distortion=torch.zeros_like(fitted.clip.cameras.distortion),
    )
    another = replace(detector, bias_seed=detector.bias_seed + seed)
    found = another(motion, rig, fitted.clip.rate_hz, seed, "fit", "fit")
    valid = torch.from_numpy(found.valid) & fitted.clip.valid
    return Clip(
        rate_hz=fitted.clip.rate_hz,
        cameras=rig,
        key_points=torch.from_numpy(found.key_points).double(),
        confidence=torch.from_numpy(found.confidence).double(),
        valid=valid,
    )


def statistics(fitted: Fitted) -> dict[str, float]:
    """What the residuals are like, in sizes of the person; NaN where a clip does not tell it."""
    clip = fitted.clip
    pixels, _ = project(fitted.cameras.index(None), fitted.points)
    size = person_scale(clip.key_points, clip.valid)[..., None, None]
    seen = clip.valid & fitted.estimated[:, None] & (clip.valid.sum(1, keepdim=True) >= 3)
    residual = torch.where(seen[..., None], (clip.key_points - pixels) / size, torch.nan)
    length = residual.norm(dim=-1)
    enough = seen.sum(0) >= 20
    lasting = torch.where(enough[..., None], residual.nanmedian(0).values, torch.nan)
    varying = residual - lasting
    limit = float(varying.abs()[torch.isfinite(varying)].quantile(0.95))
    lag = max(1, round(clip.rate_hz / 12))
    a, b = torch.tensor(BONES).T
    confidence = clip.confidence[seen]
    known = bool((confidence != confidence[:1]).any())
    rank = spearmanr(length[seen], confidence).statistic if known else np.nan
    return {
        "50 %": float(length[seen].quantile(0.5)),
        "90 %": float(length[seen].quantile(0.9)),
        "99 %": float(length[seen].quantile(0.99)),
        "lasting": _deviation(lasting),
        "varying": _deviation(varying),
        "after 1/12 s": _correlation(varying[:-lag], varying[lag:], limit),
        "after 1/3 s": _correlation(varying[: -4 * lag], varying[4 * lag :], limit),
        "neighbours": _correlation(varying[:, :, a], varying[:, :, b], limit),
        "confidence": -float(rank),
        "flipped": float(fitted.flipped.double().mean()),
        "missing": 1.0 - float(clip.valid.double().mean()),
    }


def _deviation(values: torch.Tensor) -> float:
    finite = values[torch.isfinite(values)]
    return 1.4826 * float(finite.abs().median())


def _correlation(a: torch.Tensor, b: torch.Tensor, limit: float) -> float:
    inside = (a.abs() < limit) & (b.abs() < limit)
    return float(torch.corrcoef(torch.stack((a[inside], b[inside])))[0, 1])


def mean(rows: list[dict[str, float]]) -> dict[str, float]:
    """Geometric over the sets where it is positive, else arithmetic; of those that tell it."""
    result = {}
    for name in rows[0]:
        values = np.array([row[name] for row in rows])
        values = values[np.isfinite(values)]
        positive = bool((values > 0).all())
        result[name] = float(np.exp(np.log(values).mean()) if positive else values.mean())
    return result


def simulate(
    real: list[Fitted],
    motions: list[np.ndarray],
    detector: Detector,
    calibration: RigCalibration,
    seeds: tuple[int, ...],
) -> list[dict[str, float]]:
    """The statistics of each set detected again, means over the seeds."""
    rows = []
    for fitted, motion in zip(real, motions, strict=True):
        drawn = []
        for seed in seeds:
            again = detect_again(fitted, motion, detector, seed)
            drawn.append(statistics(adjust(again, calibration)))
        rows.append({name: float(np.mean([row[name] for row in drawn])) for name in drawn[0]})
        if np.isnan(statistics(fitted)["confidence"]):
            rows[-1]["confidence"] = np.nan
    return rows


def fit(detector: Detector, target: dict[str, float], simulated: dict[str, float]) -> Detector:
    """The detector with each free number multiplied by what its statistic lacks."""
    numbers = {}
    for name, statistic in FREE.items():
        lacking = target[statistic] / max(simulated[statistic], 0.1 * target[statistic])
        number = getattr(detector, name) * np.clip(lacking, 0.5, 2.0) ** 0.7
        numbers[name] = float(f"{min(number, LIMITS.get(name, np.inf)):.3g}")
    for name, (leader, ratio) in TIED.items():
        numbers[name] = float(f"{ratio * numbers[leader]:.3g}")
    return replace(detector, **numbers)


def report(
    console: Console, real: list[dict[str, float]], simulated: list[dict[str, float]]
) -> None:
    table = Table(title="residuals in sizes of the person: real / simulated")
    for column in ("", "mean", *RECORDINGS):
        table.add_column(column, justify="right")
    pairs = [(mean(real), mean(simulated)), *zip(real, simulated, strict=True)]
    for name in real[0]:
        table.add_row(name, *(f"{one[name]:.4f} / {other[name]:.4f}" for one, other in pairs))
    console.print(table)


def write(path: Path, detector: Detector) -> None:
    free = ", ".join(FREE)
    header = [
        "# The synthetic detector of recordings in the field. Written by",
        "# scripts/fit_field_detector.py, which fitted",
        f"# {free}",
        "# to the residuals of three real detectors.",
        "# Lengths in statures, rates as shares of the time, durations in seconds.",
    ]
    with atomic_write(path, "w") as handle:
        handle.write("\n".join(header) + "\n")
        yaml.safe_dump(
            dict(vars(detector)), handle, sort_keys=False, default_flow_style=None, width=100
        )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="do not fit, do not write")
    parser.add_argument("--shared", type=Path, default=SHARED, help="the real recordings")
    arguments = parser.parse_args()
    if not arguments.shared.is_dir():
        print(f"{arguments.shared} is not there: nothing to fit to.")
        return
    console = Console(width=140)
    path = CONF / "detector" / "field.yaml"
    detector = Detector(**yaml.safe_load(path.read_text()))
    settings = yaml.safe_load((CONF / "calibration" / "default.yaml").read_text())
    calibration = build(settings, "calibration")
    real = [adjust(read(name, arguments.shared), calibration) for name in RECORDINGS]
    motions = [motion_of(fitted) for fitted in real]
    target = [statistics(fitted) for fitted in real]
    if not arguments.check:
        detector = replace(detector, **HELD)
        for _ in range(TURNS):
            simulated = mean(simulate(real, motions, detector, calibration, SEEDS[:2]))
            detector = fit(detector, mean(target), simulated)
        write(path, detector)
    report(console, target, simulate(real, motions, detector, calibration, SEEDS))
    console.print({name: getattr(detector, name) for name in FREE})


if __name__ == "__main__":
    main()
