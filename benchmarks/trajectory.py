"""What the trajectory is worth beside estimates of single frames, as it is and spoilt on purpose.

    python benchmarks/trajectory.py [--takes 20] [--split test] [--motion cmu.npz]

Synthetic Human3.6M, 320 successive frames of each take. ``w``: what is spoilt is drawn anew for
every frame; ``p``: it lasts. Prints a Markdown table: pelvis-relative MPJPE (mm), the share of the
joints that are estimated and the error of velocities, the last for the online form, which knows
nothing of a take when it begins (``--lag``, seconds); then coverage of the covariances against the
detector's own definition of the joints, and frames per second of processor time. ``--motion``: real
motion instead, [N 17 3] in mm with ``clip_start``, before Human3.6M's rig of the validation person.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from omegaconf import OmegaConf

from ghpt.api import default_settings
from ghpt.commands.prediction.estimator import build_estimator
from ghpt.config import CONF, build
from ghpt.data.synthetic.detector import Detector
from ghpt.data.synthetic.recordings import Take, takes
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.geometry.cameras import CameraSet
from ghpt.models.estimators.classical import Estimator, person_scale
from ghpt.models.estimators.predictors import remove_outliers
from ghpt.models.estimators.trajectory.disjoint import observed_by_two, square_distances
from ghpt.models.estimators.trajectory.estimator import Trajectory
from ghpt.models.estimators.trajectory.online_predictor import OnlinePredictor
from ghpt.models.estimators.trajectory.windows import Clock
from ghpt.observations import Observations, PoseEstimate
from ghpt.skeleton import HUMAN36M, JOINTS, MIRROR, PELVIS

FRAMES = 320
LASTING_S = 0.3
Spoil = Callable[["Recorded", "Recorded", np.random.Generator], Observations]


@dataclass(frozen=True)
class Recorded:
    """Successive frames of one take."""

    observations: Observations
    truth: Float[torch.Tensor, "T J 3"]
    apparent: Float[torch.Tensor, "T J 3"]
    """Where the joints are by the detector's own definition."""
    rate_hz: float


def lasting(
    generator: np.random.Generator, shape: tuple[int, ...], rate: float, frames: int
) -> Bool[np.ndarray, "T ..."]:
    """Return a random mask in blocks of so many frames, which begin anywhere."""
    blocks = generator.random((shape[0] // frames + 2, *shape[1:])) < rate
    offset = generator.integers(0, frames, shape[1:])
    number = np.arange(shape[0]).reshape(-1, *[1] * (len(shape) - 1))
    return np.take_along_axis(blocks, (number + offset) // frames, 0)


def outliers(rate: float, seconds: float | None) -> Spoil:
    """Move key points by 10 to 50 % of the person's size in the image."""

    def spoil(one: Recorded, _: Recorded, generator: np.random.Generator) -> Observations:
        batch = one.observations
        frames = 1 if seconds is None else round(seconds * one.rate_hz)
        shape = batch.valid.shape
        moved = lasting(generator, shape, rate, frames)
        blocks = (shape[0] // frames + 1, *shape[1:])
        angle = np.repeat(2 * np.pi * generator.random(blocks), frames, 0)[: shape[0]]
        length = np.repeat(0.1 + 0.4 * generator.random(blocks), frames, 0)[: shape[0]]
        size = person_scale(batch.key_points, batch.valid)[..., None].numpy()
        offset = (moved * size * length)[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1)
        return replace(batch, key_points=batch.key_points + torch.from_numpy(offset).float())

    return spoil


def missing(rate: float, seconds: float | None) -> Spoil:
    """Take key points away."""

    def spoil(one: Recorded, _: Recorded, generator: np.random.Generator) -> Observations:
        batch = one.observations
        frames = 1 if seconds is None else round(seconds * one.rate_hz)
        gone = torch.from_numpy(lasting(generator, batch.valid.shape, rate, frames))
        return replace(batch, valid=batch.valid & ~gone)

    return spoil


def flips(rate: float) -> Spoil:
    """Exchange left and right of whole views."""

    def spoil(one: Recorded, _: Recorded, generator: np.random.Generator) -> Observations:
        batch = one.observations
        frames = round(LASTING_S * one.rate_hz)
        flipped = torch.from_numpy(lasting(generator, batch.valid.shape[:2], rate, frames))
        mirror = list(MIRROR)
        return _mixed(batch, _joints(batch, mirror), flipped)

    return spoil


def other_people(rate: float) -> Spoil:
    """Show somebody else in whole views."""

    def spoil(one: Recorded, other: Recorded, generator: np.random.Generator) -> Observations:
        batch = one.observations
        frames = round(LASTING_S * one.rate_hz)
        wrong = torch.from_numpy(lasting(generator, batch.valid.shape[:2], rate, frames))
        again = torch.arange(len(batch)) % len(other.observations)
        return _mixed(batch, other.observations.rows(again), wrong)

    return spoil


def views(count: int) -> Spoil:
    """Keep the first views."""

    def spoil(one: Recorded, _: Recorded, generator: np.random.Generator) -> Observations:
        batch = one.observations
        valid = batch.valid.clone()
        valid[:, count:] = False
        return replace(batch, valid=valid)

    return spoil


def as_it_is(one: Recorded, _: Recorded, generator: np.random.Generator) -> Observations:
    return one.observations


CONDITIONS: dict[str, Spoil] = {
    "as it is": as_it_is,
    "outliers 10 % w": outliers(0.1, None),
    "outliers 30 % w": outliers(0.3, None),
    "outliers 10 % p": outliers(0.1, LASTING_S),
    "outliers 20 % p": outliers(0.2, LASTING_S),
    "outliers 30 % p": outliers(0.3, LASTING_S),
    "half missing w": missing(0.5, None),
    "half missing p": missing(0.5, 0.6 * LASTING_S),
    "flips 5 %": flips(0.05),
    "other people 10 %": other_people(0.1),
    "3 views": views(3),
    "2 views": views(2),
}


def _joints(batch: Observations, order: list[int]) -> Observations:
    return replace(
        batch,
        key_points=batch.key_points[:, :, order],
        confidence=batch.confidence[:, :, order],
        valid=batch.valid[:, :, order],
    )


def _mixed(batch: Observations, other: Observations, mask: torch.Tensor) -> Observations:
    """Return the views of ``other`` where the mask [T V] says so."""
    by_joint = mask[..., None]
    return replace(
        batch,
        key_points=torch.where(by_joint[..., None], other.key_points, batch.key_points),
        confidence=torch.where(by_joint, other.confidence, batch.confidence),
        valid=torch.where(by_joint, other.valid, batch.valid),
    )


def recorded(take: Take, detector: Detector) -> Recorded:
    """Return the middle frames of a take as an unfamiliar detector sees them."""
    found = detector(take.truth, take.rig, take.rate_hz, 0, take.subject, take.name, False)
    body = detector.draw_body_error(len(take.truth), take.rate_hz, 0, take.subject, take.name)
    apparent = detector.displace_joints(take.truth, body, False)
    first = max(0, (len(take.truth) - FRAMES) // 2)
    rows = np.arange(first, min(first + FRAMES, len(take.truth)))
    cameras = take.rig.cameras.to(torch.float64).expand(len(rows))
    observations = Observations(
        index=torch.arange(len(rows)),
        recording=torch.zeros(len(rows), dtype=torch.int64),
        cameras=cameras,
        key_points=torch.from_numpy(found.key_points[rows]),
        confidence=torch.from_numpy(found.confidence[rows]),
        valid=torch.from_numpy(found.valid[rows]),
    )
    truth = torch.from_numpy(take.truth[rows])
    return Recorded(observations, truth, torch.from_numpy(apparent[rows]), take.rate_hz)


def motion_takes(path: Path) -> Iterator[Take]:
    """Yield real motion, standing where the validation subject does."""
    rig: CameraSet = human36m_rig("S8")
    place = next(iter(takes("h36m", "validation", 0))).truth.mean((0, 1))
    with np.load(path, allow_pickle=False) as file:
        order = [file["joint_name"].tolist().index(joint) for joint in JOINTS]
        poses = next(file[name] for name in file.files if file[name].ndim == 3)[:, order]
        starts = [*file["clip_start"].tolist(), len(poses)]
    for number, (start, end) in enumerate(pairwise(starts)):
        if end - start < 60:
            continue
        truth = poses[start:end].astype(np.float64)
        truth[..., :2] += place[:2] - truth[..., :2].mean((0, 1))
        truth[..., 2] -= truth[..., 2].min() - 20
        yield Take(f"clip {number}", f"clip {number}", "motion", 60.0, rig, truth, False, 0)


@dataclass
class Row:
    """Sums over the takes of one condition and estimator."""

    errors: list[torch.Tensor]
    placed: list[torch.Tensor]
    speed: list[torch.Tensor]
    seconds: float = 0.0
    frames: int = 0

    def add(self, found: PoseEstimate, one: Recorded, seconds: float) -> None:
        points = found.points.double()
        estimated = found.estimated & found.estimated[:, PELVIS, None]
        relative = points - points[:, PELVIS, None]
        truth = one.truth - one.truth[:, PELVIS, None]
        self.errors.append((relative - truth).norm(dim=-1)[estimated])
        self.placed.append(found.estimated.double().flatten())
        moving = (points.diff(dim=0) - one.truth.diff(dim=0)).norm(dim=-1)
        self.speed.append(moving[found.estimated[1:] & found.estimated[:-1]])
        self.seconds += seconds
        self.frames += len(points)

    def text(self) -> str:
        error = torch.cat(self.errors)
        placed = 100 * float(torch.cat(self.placed).mean())
        speed = float(torch.cat(self.speed).mean())
        return (
            f"{float(error.mean()):.2f} ({float(error.median()):.2f}) | {placed:.0f} | {speed:.2f}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--takes", type=int, default=20)
    parser.add_argument("--split", default="test")
    parser.add_argument("--motion", type=Path)
    parser.add_argument("--conditions", default="")
    parser.add_argument("--lag", type=float, default=0.1)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    everything = (
        list(motion_takes(arguments.motion))
        if arguments.motion
        else list(takes("h36m", arguments.split, 0))
    )
    chosen = np.unique(np.linspace(0, len(everything) - 1, arguments.takes).astype(int))
    values = OmegaConf.to_container(OmegaConf.load(CONF / "detector/human36m.yaml"))
    detector = Detector(**values)
    recordings = [recorded(everything[number], detector) for number in chosen]
    settings = default_settings()
    trajectory: Trajectory = build_estimator(settings).predictor.trajectory
    live = default_settings(estimator="online", lag=arguments.lag)
    online: OnlinePredictor = build_estimator(live).predictor
    frame: Estimator = build(settings.baselines["adaptive_ransac"], "baselines")
    header = ["mm (median)", "placed %", "velocity, mm/frame"]
    columns = [
        f"{name}, {column}"
        for name in ("adaptive RANSAC", "trajectory", "online")
        for column in header
    ]
    print("|", " | ".join(["condition", *columns]), "|\n|" + "---|" * 10)
    names = [name for name in CONDITIONS if arguments.conditions in name]
    rows: dict[str, tuple[Row, Row, Row]] = {}
    distances = []
    for condition in names:
        alone = Row([], [], [])
        whole = Row([], [], [])
        live_row = Row([], [], [])
        for number, one in enumerate(recordings):
            generator = np.random.default_rng([number, 1])
            other = recordings[(number + 7) % len(recordings)]
            batch, _ = remove_outliers(CONDITIONS[condition](one, other, generator))
            start = time.process_time()
            first = frame(batch)
            alone.add(first, one, time.process_time() - start)
            fitted = trajectory.at_rate(batch, one.rate_hz).fit_to(batch)
            if condition == "as it is":
                fitted = fitted.calibrate(batch)
            start = time.process_time()
            found = fitted.complete(batch)
            whole.add(found, one, time.process_time() - start)
            clock = Clock.of_frames(batch.index.numpy(), one.rate_hz, trajectory.longest_gap_s)
            start = time.process_time()
            found = replace(online, clock=clock).estimate(batch)
            live_row.add(found, one, time.process_time() - start)
            if condition == "as it is":
                part = fitted.solve(batch, first, with_covariance=True)
                agreed = observed_by_two(part.views)
                offset = (part.points - one.apparent)[agreed]
                distances.append(square_distances(offset, part.covariance[agreed]))
        rows[condition] = (alone, whole, live_row)
        texts = " | ".join(row.text() for row in rows[condition])
        print(f"| {condition} | {texts} |", flush=True)
    alone, whole, live_row = rows[names[0]]
    print(f"\nframes/s of processor time: {alone.frames / alone.seconds:.0f} adaptive RANSAC,")
    print(f"{whole.frames / whole.seconds:.0f} trajectory with its start ({len(HUMAN36M)} joints)")
    print(f"{live_row.frames / live_row.seconds:.0f} online, its beginning and all")
    if distances:
        square = torch.cat(distances)
        shares = [float((square <= limit).double().mean()) for limit in (2.366, 6.251, 7.815)]
        print("covered by the ellipsoids of 50, 90 and 95 %:", [round(100 * x) for x in shares])


if __name__ == "__main__":
    main()
