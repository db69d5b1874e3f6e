"""Triangulation of whole recordings beside its peers: ``python benchmarks/recordings.py``.

The key points and cameras are the same for all. Synthetic Human3.6M, 320 frames of each take (the
conditions are those of ``trajectory.py``): the mean error of the joints that a method estimates,
and of the joints that all of them do, mm; and the share that it estimates, because who leaves the
hard joints out has a smaller error. Real recordings of ``folder=`` (Pose2Sim's demo and
caliscope's, 17 joints), which have no truth: each view is left out in turn, and the joints of the
other views are projected into it; the median distance from its key points, pixels, and the share of
its key points that get one. The cameras are the file's.

aniposelib is the PyTorch one, and is left out where it is not installed. Pose2Sim's method is
written anew from its publication, without the exchange of sides (off by default there).

Settings: ``takes=8`` ``split=test`` ``detector=human36m`` ``conditions=as it is,outliers 10 % w``
(none: real recordings alone) ``tau=10,20`` (aniposelib's thresholds, pixels: its default, and the
best on the validation split) ``pose2sim=15,10`` (the same of Pose2Sim) ``folder=`` (none: synthetic
data alone).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from measure import configuration, machine, settings, show
from peers import anipose_linear, anipose_msac, installed, pose2sim, pose2sim_filtered
from trajectory import CONDITIONS, Recorded, recorded

import ghpt
from ghpt.api import default_settings
from ghpt.commands.prediction.estimator import build_estimator
from ghpt.config import build
from ghpt.data.people.persons import person_sequence
from ghpt.data.synthetic.detector import Detector
from ghpt.data.synthetic.recordings import takes
from ghpt.geometry.cameras import reprojection_error
from ghpt.models.estimators.predictors import remove_outliers
from ghpt.observations import Observations, PoseEstimate

Method = Callable[[Observations, float], PoseEstimate]
"""All frames of a recording, and their rate in Hz."""

REAL = {
    "Pose2Sim's demo": ("pose2sim_single/pose", "pose2sim_single/Calib_qualisys.toml", 60.0),
    "caliscope's": ("caliscope/xy_HOLISTIC.csv", "caliscope/camera_array.toml", 30.0),
}


@dataclass(frozen=True)
class Score:
    """Errors of a method over all that could be estimated."""

    error: Float[torch.Tensor, " N"]
    estimated: Bool[torch.Tensor, " N"]
    seconds: float
    frames: int


def ours() -> dict[str, Method]:
    """Return what predict.py offers without a checkpoint."""
    wanted = default_settings()
    frame = build(wanted.baselines["adaptive_ransac"], "baselines")
    trajectory = build_estimator(wanted).predictor.trajectory

    def whole(batch: Observations, rate_hz: float) -> PoseEstimate:
        return trajectory.at_rate(batch, rate_hz).fit_to(batch).complete(batch)

    return {"ghpt, adaptive RANSAC": by_frame(frame), "ghpt, trajectory": whole}


def theirs(taus: list[float], largest_errors: list[float]) -> dict[str, Method]:
    """Return the peers that can be run, with each of their thresholds."""
    methods: dict[str, Method] = {}
    if installed("aniposelib-pytorch"):
        methods["aniposelib, linear"] = by_frame(anipose_linear)
        for tau in taus:
            methods[f"aniposelib, MSAC {tau:g} px"] = by_frame(partial(anipose_msac, tau=tau))
    for limit in largest_errors:
        name = f"Pose2Sim's exclusion {limit:g} px"
        methods[name] = by_frame(partial(pose2sim, largest_error=limit))
        methods[f"{name}, filtered"] = partial(pose2sim_filtered, largest_error=limit)
    return methods


def by_frame(estimate: Callable[[Observations], PoseEstimate]) -> Method:
    """Return a method for which the rate does not matter."""

    def method(batch: Observations, rate_hz: float) -> PoseEstimate:
        return estimate(batch)

    return method


def score_synthetic(method: Method, batches: list[Observations], truths: list[Recorded]) -> Score:
    """Return the distances from the truth, mm."""
    began = time.process_time()
    found = [method(batch, one.rate_hz) for batch, one in zip(batches, truths, strict=True)]
    seconds = time.process_time() - began
    errors = []
    for estimate, one in zip(found, truths, strict=True):
        errors.append((estimate.points.double() - one.truth).norm(dim=-1).flatten())
    estimated = torch.cat([estimate.estimated.flatten() for estimate in found])
    return Score(torch.cat(errors), estimated, seconds, sum(map(len, batches)))


def score_real(method: Method, batch: Observations, rate_hz: float) -> Score:
    """Return the distances of key points in left-out views, pixels."""
    errors = []
    estimated = []
    began = time.process_time()
    for view in range(batch.valid.shape[1]):
        others = batch.valid.clone()
        others[:, view] = False
        found = method(replace(batch, valid=others), rate_hz)
        own = slice(view, view + 1)
        camera = batch.cameras.index(0).index(own)
        error = reprojection_error(camera, batch.key_points[:, own].double(), found.points.double())
        shown = batch.valid[:, view]
        errors.append(error[:, 0][shown])
        estimated.append(found.estimated[shown])
    seconds = time.process_time() - began
    return Score(
        torch.cat(errors), torch.cat(estimated), seconds, len(batch) * batch.valid.shape[1]
    )


def rows(scores: dict[str, Score], summary: Callable[[torch.Tensor], torch.Tensor]) -> list[list]:
    """Return for each method its error, that on everybody's joints, coverage and speed."""
    common = torch.stack([one.estimated for one in scores.values()]).all(0)
    table = []
    for name, one in scores.items():
        own = f"{float(summary(one.error[one.estimated])):.2f}"
        shared = f"{float(summary(one.error[common])):.2f}"
        covered = f"{100 * float(one.estimated.double().mean()):.1f}"
        table.append([name, own, shared, covered, f"{one.frames / one.seconds:,.0f}"])
    return table


def read_real(folder: Path, key_points: str, cameras: str) -> Observations:
    """Return all frames of the person of a recording, out of the lens."""
    people = ghpt.read_key_points(folder / key_points)
    sequence = person_sequence(people, ghpt.read_cameras(folder / cameras))
    return sequence.read(np.arange(len(sequence.frame)))


def main() -> None:
    wanted = settings(
        takes=8,
        split="test",
        detector="human36m",
        conditions="as it is,outliers 10 % w",
        tau="10,20",
        pose2sim="15,10",
        folder="",
    )
    torch.set_num_threads(1)
    thresholds = ([float(x) for x in wanted[name].split(",")] for name in ("tau", "pose2sim"))
    methods = ours() | theirs(*thresholds)
    detector = Detector(**configuration(f"detector/{wanted['detector']}")["detector"])
    every = list(takes("h36m", wanted["split"], 0))
    chosen = np.linspace(0, len(every) - 1, wanted["takes"]).astype(int)
    truths = [recorded(every[number], detector) for number in chosen]
    print(machine())
    header = ["on joints that all give", "estimated, %", "frames/s"]
    for condition in filter(None, wanted["conditions"].split(",")):
        batches = []
        for number, one in enumerate(truths):
            generator = np.random.default_rng([number, 1])
            spoilt = CONDITIONS[condition](one, truths[number - 1], generator)
            batches.append(remove_outliers(spoilt)[0])
        scores = {name: score_synthetic(way, batches, truths) for name, way in methods.items()}
        show(
            f"{wanted['detector']}, {condition}",
            ["method", "mean, mm", *header],
            rows(scores, torch.mean),
        )
    if not wanted["folder"]:
        return
    for name, (key_points, cameras, rate_hz) in REAL.items():
        batch = read_real(Path(wanted["folder"]), key_points, cameras)
        scores = {how: score_real(way, batch, rate_hz) for how, way in methods.items()}
        show(name, ["method", "median, px", *header], rows(scores, torch.median))


if __name__ == "__main__":
    main()
