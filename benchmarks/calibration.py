"""Calibration from people beside its peers: ``python benchmarks/calibration.py``.

People of the test subjects walk before Human3.6M's four cameras (``rig=panoptic``: before ten of
Panoptic's), as a synthetic detector sees them: 80 frames spread over a take, and 600 successive
ones; as they are, and with one key point in ten moved by 10 to 50 % of the person's size. Everybody
gets the same key points and the same, true, intrinsics. A peer that is not installed is left out.

A draw fails where no rig of all cameras comes out, or one whose cameras are turned by more than 5
degrees on average; the medians are over the others. ``rotation`` is the mean over the cameras after
the best alignment of the rigs. ``points`` is what the rig makes of true images of the places where
the person goes in the whole take, after a similarity: the mean distance. ``s`` is processor time.

Settings: ``draws=4`` ``rig=h36m`` ``detector=human36m,field``
``recordings=spread-80,successive-600``
``outliers=0,0.1`` ``split=test`` (``validation``: where settings are chosen) ``peers=`` (words
that the names contain; none: all) ``caliscope_filter=2.5,10`` ``threads=1``.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np
import torch
from jaxtyping import Float
from measure import configuration, machine, settings, show
from peers import (
    CALISCOPE_FILTER,
    Calibrate,
    Evidence,
    NotPlaced,
    Peer,
    aniposelib,
    caliscope,
    installed,
)

from ghpt.calibration.comparison import rig_difference
from ghpt.calibration.rig import RigCalibration
from ghpt.config import build
from ghpt.data.synthetic.detector import Detector
from ghpt.data.synthetic.recordings import Take, takes
from ghpt.geometry.cameras import Cameras, project
from ghpt.geometry.rotations import procrustes
from ghpt.geometry.triangulation import triangulate
from ghpt.observations import Observations
from ghpt.paper.robustness.perturbation import Outliers

PANOPTIC = range(0, 30, 3)
"""Ten of its 31 HD cameras."""
WRONG_DEG = 5.0
VOLUME_FRAMES = 100


@dataclass(frozen=True)
class Draw:
    """A recording, and what its rig really is."""

    evidence: Evidence
    cameras: Cameras
    """float64."""
    volume: Float[torch.Tensor, "N 3"]
    """Where the joints are in the whole take, mm."""


@dataclass(frozen=True)
class Outcome:
    """What one calibration of one draw is worth."""

    rotation_deg: float
    points_mm: float
    seconds: float
    failed: bool


def chosen_takes(rig: str, split: str, draws: int) -> list[Take]:
    """Return takes of people who walk (Panoptic: who move), of all subjects in turn."""
    cameras = PANOPTIC if rig == "panoptic" else None
    everything = list(takes(rig, split, 0, cameras))
    walks = [take for take in everything if rig == "panoptic" or take.action.startswith("Walk")]
    return [walks[i] for i in np.linspace(0, len(walks) - 1, draws).astype(int)]


def frames_of(recording: str, frames: int) -> np.ndarray:
    """Return the frames of ``spread-80`` or ``successive-600`` in a take."""
    kind, _, count = recording.partition("-")
    if kind == "spread":
        return np.linspace(0, frames - 1, int(count)).astype(int)
    first = (frames - int(count)) // 2
    return np.arange(first, first + int(count))


def draw(take: Take, detector: Detector, recording: str, outliers: float) -> Draw:
    """Return what the detector sees of a take."""
    found = detector(take.truth, take.rig, take.rate_hz, 0, take.subject, take.name, False)
    rows = frames_of(recording, len(take.truth))
    cameras = take.rig.cameras.to(torch.float64)
    batch = Observations(
        index=torch.from_numpy(rows),
        recording=torch.zeros(len(rows), dtype=torch.int64),
        cameras=cameras.expand(len(rows)),
        key_points=torch.from_numpy(found.key_points[rows]),
        confidence=torch.from_numpy(found.confidence[rows]),
        valid=torch.from_numpy(found.valid[rows]),
    )
    batch = Outliers(outliers, shortest=0.1, longest=0.5)(batch, 0)
    evidence = Evidence(
        batch.key_points.transpose(0, 1).double().numpy(),
        batch.valid.transpose(0, 1).numpy(),
        cameras.K.numpy(),
        take.rig.image_size.numpy(),
    )
    shown = np.linspace(0, len(take.truth) - 1, VOLUME_FRAMES).astype(int)
    return Draw(evidence, cameras, torch.from_numpy(take.truth[shown]).double().flatten(0, 1))


def ours(calibration: RigCalibration, evidence: Evidence) -> Cameras:
    """Return the rig of `calibrate.py`, without the length and the world that it adds."""
    views = len(evidence.K)
    valid = torch.from_numpy(evidence.valid).transpose(0, 1)
    estimate = calibration(
        [f"c{v}" for v in range(views)],
        torch.from_numpy(evidence.K),
        torch.from_numpy(evidence.key_points).transpose(0, 1),
        valid.double(),
        valid,
        torch.from_numpy(evidence.size),
        seed=0,
    )
    if not estimate.succeeded:
        raise NotPlaced("; ".join(found.code for found in estimate.findings))
    return estimate.cameras


def points_error(cameras: Cameras, one: Draw) -> float:
    """Return the mean error of the volume's points after a similarity, mm."""
    pixels, depth = project(one.cameras, one.volume)
    found = triangulate(cameras, pixels, (depth > 0).double())
    aligned = procrustes(found.points, one.volume, found.ok)
    return float((aligned - one.volume).norm(dim=-1)[found.ok].mean())


def attempt(calibrate: Calibrate, one: Draw) -> Outcome:
    """Calibrate a draw and measure what comes out."""
    began = time.process_time()
    try:
        cameras = calibrate(one.evidence)
    except Exception as error:  # whatever a peer raises is a failure of the draw, and is told
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return Outcome(np.nan, np.nan, time.process_time() - began, True)
    seconds = time.process_time() - began
    rotation = float(rig_difference(cameras, one.cameras).rotation_deg.mean())
    return Outcome(rotation, points_error(cameras, one), seconds, not rotation <= WRONG_DEG)


def row(label: str, outcomes: list[Outcome]) -> list[str]:
    """Return a method's medians over the draws that did not fail, and how many failed."""
    kept = [one for one in outcomes if not one.failed]
    failed = f"{len(outcomes) - len(kept)} of {len(outcomes)}"
    seconds = f"{np.median([one.seconds for one in outcomes]):.1f}"
    if not kept:
        return [label, "", "", seconds, failed]
    rotation = f"{np.median([one.rotation_deg for one in kept]):.3f}"
    points = f"{np.median([one.points_mm for one in kept]):.1f}"
    return [label, rotation, points, seconds, failed]


def calibrations(filters: str, words: str) -> list[Peer]:
    """Return ours and the peers whose names contain one of the words."""
    calibration = build(configuration("calibrate")["calibration"], "calibration")
    every = [Peer("ghpt", None, partial(ours, calibration))]
    for value in map(float, filters.split(",")):
        how = "" if value == CALISCOPE_FILTER else f", filter {value:g} %"
        method = partial(caliscope, filter_percentile=value)
        every.append(Peer(f"caliscope{how}", "caliscope", method))
    every.append(Peer("aniposelib-pytorch", "aniposelib-pytorch", aniposelib))
    return [peer for peer in every if any(word in peer.name for word in words.split(","))]


def main() -> None:
    wanted = settings(
        draws=4,
        rig="h36m",
        detector="human36m,field",
        recordings="spread-80,successive-600",
        outliers="0,0.1",
        split="test",
        peers="",
        caliscope_filter="2.5,10",
        threads=1,
    )
    torch.set_num_threads(wanted["threads"])
    chosen = calibrations(wanted["caliscope_filter"], wanted["peers"])
    peers = [peer for peer in chosen if installed(peer.package)]
    walks = chosen_takes(wanted["rig"], wanted["split"], wanted["draws"])
    cases = product(*(wanted[name].split(",") for name in ("detector", "recordings", "outliers")))
    print(machine())
    columns = ["method", "rotation, deg", "points, mm", "s", "failed"]
    for name, recording, outliers in cases:
        detector = Detector(**configuration(f"detector/{name}")["detector"])
        draws = [draw(take, detector, recording, float(outliers)) for take in walks]
        rows = []
        for peer in peers:
            rows.append(row(peer.name, [attempt(peer.calibrate, one) for one in draws]))
        title = f"{wanted['rig']}, {name}, {recording} frames, {float(outliers):.0%} outliers"
        show(title, columns, rows)


if __name__ == "__main__":
    main()
