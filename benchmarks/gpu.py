"""What a GPU computes beside the CPU, and how fast: ``python benchmarks/gpu.py``.

Three tables, in at most five minutes:

1. Parity (row C7 of the reliability scorecard): the states of all degenerate cases are the same on
   both devices, random draws are the same to the bit, results differ by at most 1e-10 in float64
   and 1e-5 in float32, relative to the size of the scene or of the result (1e-6 where a case
   amplifies rounding).
2. Speed and peak memory of a training step and of the estimators of ``predict.py``.
3. The commands as typed: a training on the GPU, its checkpoint tested and used for a prediction.

Exits with status 1 if a row of the first or third table fails. Without a GPU it says so and
compares the CPU with itself, which shows only that the script runs.

Settings: ``device=cuda`` ``least=1.0`` (seconds for each timing) ``samples=512`` (of the training)
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scene
import torch
from measure import ROOT, configuration, machine, seconds, settings, show
from torch import Tensor

from ghpt import randomness
from ghpt.commands.catalogue import run_by_name
from ghpt.config import build
from ghpt.data.datasets.frames import Frames
from ghpt.geometry.cameras import Cameras, project
from ghpt.geometry.epipolar import eight_point, normalise
from ghpt.geometry.subsets import random_subsets
from ghpt.geometry.triangulation import triangulate, triangulate_subsets
from ghpt.models.module import StochasticEstimator
from ghpt.observations import Labelled, Observations

sys.path.insert(0, str(ROOT / "tests"))
from degenerate import DEGENERATE, degenerate

DOUBLE = 1e-10
SINGLE = 1e-5
ILL_POSED = 1e-6
"""For what amplifies rounding: degenerate cases, eigenvectors, iterated weights."""
SCENE_SIZE = 6000.0
"""Millimetres, by which differences of positions are divided."""
CPU = torch.device("cpu")
ESTIMATORS = ("linear", "weighted_linear", "ransac", "adaptive_ransac", "m_estimator")


@dataclass(frozen=True)
class Parity:
    """How two devices' results of one computation compare."""

    name: str
    difference: float
    """The largest, relative."""
    tolerance: float
    decisions_differ: int
    """States, masks and integers that are not the same."""

    @property
    def holds(self) -> bool:
        return self.decisions_differ == 0 and self.difference <= self.tolerance

    def row(self) -> list[str]:
        return [
            self.name,
            f"{self.difference:.1e}",
            f"{self.tolerance:.0e}",
            str(self.decisions_differ),
            "yes" if self.holds else "**no**",
        ]


def labelled(frames: int, views: int = 4) -> Labelled:
    """Return frames of a synthetic recording with its truth."""
    recording = scene.take("gpu", frames, scene.ring(views), np.random.default_rng(views))
    return Frames([recording], np.arange(frames))[range(frames)]


def pose_model() -> StochasticEstimator:
    """Return the configured pose model with the weights of its seed and fitted statistics."""
    model = build(configuration("train", "model=pose")["model"], "model")
    model.fit_statistics([labelled(64).observations])
    return model


def difference(a: Tensor, b: Tensor, scale: float | None = None) -> float:
    """Return the largest difference, relative to ``scale`` or to the largest value of ``a``."""
    a = a.detach().cpu().double()
    b = b.detach().cpu().double()
    size = float(a.abs().max()) if scale is None else scale
    return float((a - b).abs().max()) / max(size, 1e-300)


def unequal(a: Tensor, b: Tensor) -> int:
    """Return how many elements are not the same."""
    return int((a.cpu() != b.cpu()).sum())


def parity(device: torch.device) -> list[Parity]:
    """Compare the device with the CPU, computation by computation."""
    observations = labelled(200).observations
    there = observations.to(device)
    return [
        compare_degenerate(device),
        *compare_draws(observations, there),
        compare_two_views(device),
        *compare_estimators(observations, there),
        *compare_model(observations, there, device),
    ]


def compare_degenerate(device: torch.device) -> Parity:
    """Compare the triangulation of every degenerate and broken case."""
    worst = 0.0
    states = 0
    for name in DEGENERATE:
        case, weights = degenerate(name)
        here = triangulate(case.cameras, case.key_points, weights)
        there = triangulate(case.cameras.to(device), case.key_points.to(device), weights.to(device))
        states += unequal(here.status, there.status)
        worst = max(worst, difference(here.points, there.points, SCENE_SIZE))
    return Parity(f"triangulation, {len(DEGENERATE)} degenerate cases", worst, ILL_POSED, states)


def compare_draws(observations: Observations, there: Observations) -> list[Parity]:
    """Compare the random subsets of views and what is triangulated from them."""

    def draw(batch: Observations) -> tuple[Tensor, Tensor, Tensor]:
        keys = randomness.key(0, "gpu", batch.index, device=batch.index.device)
        views = random_subsets(batch.valid, 200, keys)
        points, valid = triangulate_subsets(batch.cameras, batch.key_points, batch.valid, views)
        return views, points, valid

    views, points, valid = draw(observations)
    views_there, points_there, valid_there = draw(there)
    return [
        Parity("random subsets of views", 0.0, 0.0, unequal(views, views_there)),
        Parity(
            "hypotheses, 200 for each of 200 frames",
            difference(points, points_there, SCENE_SIZE),
            DOUBLE if points.dtype == torch.float64 else SINGLE,
            unequal(valid, valid_there),
        ),
    ]


def compare_two_views(device: torch.device) -> Parity:
    """Compare relative poses from exact correspondences of random points."""
    rng = np.random.default_rng(0)
    cameras = scene.ring(6)
    points = torch.from_numpy(rng.normal(0, 500, (64, 40, 3)))
    rig = cameras.index([0, 1])
    pair = Cameras(*(x.expand(64, *x.shape) for x in (rig.K, rig.R, rig.t)))
    pixels, _ = project(pair, points)

    def estimate(device: torch.device) -> tuple[Tensor, Tensor]:
        xy = normalise(pair.K.to(device), pixels.to(device))
        weights = torch.ones(64, 40, dtype=torch.float64, device=device)
        E, valid = eight_point(xy[:, 0], xy[:, 1], weights)
        entries = E.flatten(1)
        largest = entries.abs().argmax(1, keepdim=True)
        return E * torch.sign(entries.gather(1, largest))[..., None], valid

    here, valid = estimate(CPU)
    away, valid_there = estimate(device)
    return Parity(
        "eight-point, 64 pairs", difference(here, away), ILL_POSED, unequal(valid, valid_there)
    )


def compare_estimators(observations: Observations, there: Observations) -> list[Parity]:
    """Compare the classical estimators of ``test.py``."""
    baselines = build(configuration("test")["baselines"], "baselines")
    rows = []
    for name in ESTIMATORS:
        here = baselines[name].triangulate(observations)
        away = baselines[name].triangulate(there)
        moved = difference(here.points, away.points, SCENE_SIZE)
        rows.append(Parity(name, moved, ILL_POSED, unequal(here.status, away.status)))
    return rows


def compare_model(
    observations: Observations, there: Observations, device: torch.device
) -> list[Parity]:
    """Compare the features, logits and the weighted estimate of the pose model."""
    model = pose_model()
    here = model.sample(observations, "gpu")
    features = model.problem.featurize(here.hypotheses)
    logits = here.logits.detach()
    estimate = here.estimate("weight").points
    model = model.to(device)
    away = model.sample(there, "gpu")
    return [
        Parity(
            "features",
            difference(features, model.problem.featurize(away.hypotheses)),
            SINGLE,
            0,
        ),
        Parity("logits", difference(logits, away.logits), SINGLE, 0),
        Parity(
            "weighted estimate",
            difference(estimate, away.estimate("weight").points, SCENE_SIZE),
            SINGLE,
            0,
        ),
    ]


def synchronised(device: torch.device, call: Callable[[], Any]) -> Callable[[], None]:
    """Return the call with the device's work done before it returns."""

    def run() -> None:
        call()
        if device.type == "cuda":
            torch.cuda.synchronize(device)

    return run


def peak_mib(device: torch.device, call: Callable[[], Any]) -> str:
    """Return the largest memory on the device during a call, MiB; '' on the CPU."""
    if device.type != "cuda":
        return ""
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats(device)
    call()
    torch.cuda.synchronize(device)
    return f"{torch.cuda.max_memory_allocated(device) / 2**20:,.0f}"


def training_step(device: torch.device, frames: int) -> Callable[[], None]:
    """Return a step of the pose model: hypotheses, scores, loss, gradient, optimiser."""
    model = pose_model().to(device)
    optimizer = model.configure_optimizers()
    batch = labelled(frames).to(device)
    keys = model.keys("gumbel", batch.observations)

    def step() -> None:
        optimizer.zero_grad()
        pool = model.sample(batch.observations, "hypotheses", batch.truth, 0)
        model.terms(pool, keys).total.mean().backward()
        optimizer.step()

    return synchronised(device, step)


def prediction(device: torch.device, frames: int) -> Callable[[], None]:
    """Return the classical default of ``predict.py`` on so many frames."""
    estimator = configuration("predict")
    baseline = build(estimator["baselines"][estimator["triangulation"]], "baselines")
    predictor = build(estimator["predictor"]["classical"], "predictor.classical")(
        estimator=baseline
    )
    batch = labelled(frames).observations.to(device)
    return synchronised(device, lambda: predictor(batch))


def speed(device: torch.device, least: float) -> list[list[str]]:
    """Time both devices on the same work."""
    jobs = [
        ("training step, 16 frames x 200 hypotheses", training_step, 16),
        ("training step, 256 frames x 200 hypotheses", training_step, 256),
        ("predict, 512 frames, 4 views", prediction, 512),
        ("predict, 4,096 frames, 4 views", prediction, 4096),
    ]
    rows = []
    for name, make, frames in jobs:
        here = seconds(make(CPU, frames), least)
        call = make(device, frames)
        away = seconds(call, least)
        memory = peak_mib(device, call)
        rows.append(
            [name, f"{1000 * here:.1f}", f"{1000 * away:.1f}", f"{here / away:.1f}", memory]
        )
    return rows


def command(name: str, *words: str) -> tuple[int, float]:
    """Run a command as typed, in this process; return its exit status and its seconds."""
    sys.argv = [f"{name}.py", *words]
    start = time.perf_counter()
    status = 0
    try:
        run_by_name(name)
    except SystemExit as stop:
        status = stop.code if isinstance(stop.code, int) else 1
        if isinstance(stop.code, str):
            print(stop.code, file=sys.stderr)
    return status, time.perf_counter() - start


def commands(accelerator: str, samples: int) -> list[list[str]]:
    """Train, test and predict with the accelerator; return a row for each."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        quiet = (f"trainer.accelerator={accelerator}", "progress_bar=false")
        train = (f"data.train_samples={samples}", f"output={folder}/train")
        ckpt = f"ckpt={folder}/train/last.ckpt"
        device = torch.device("cuda" if accelerator == "gpu" else "cpu")
        for name, words in (
            ("train", ("data=cmu2", "model=pose", *train)),
            ("test", (ckpt, "data=h36m", "data.stride=64", f"output={folder}/test")),
            ("predict", (ckpt, "data=h36m", f"output={folder}/predict")),
        ):
            if device.type == "cuda":
                torch.cuda.reset_peak_memory_stats(device)
            status, taken = command(name, *words, *quiet)
            memory = ""
            if device.type == "cuda":
                memory = f"{torch.cuda.max_memory_allocated(device) / 2**20:,.0f}"
            rows.append([f"{name}.py", str(status), f"{taken:.1f}", memory, ""])
        rows[1][-1] = _mpjpe(Path(folder) / "test" / "metrics.json")
    return rows


def _mpjpe(path: Path) -> str:
    if not path.exists():
        return ""
    metrics = json.loads(path.read_text(encoding="utf-8"))
    return f"weight {metrics['selections']['weight']['mpjpe_relative']:.2f} mm"


def main() -> None:
    wanted = settings(device="cuda", least=1.0, samples=512)
    has_gpu = wanted["device"] != "cpu" and torch.cuda.is_available()
    device = torch.device(wanted["device"] if has_gpu else "cpu")
    name = torch.cuda.get_device_name(device) if has_gpu else "NO GPU HERE: the CPU beside itself"
    title = f"{name}; {machine()}"
    found = parity(device)
    show(
        f"Parity. {title}",
        ["computation", "largest difference", "allowed", "decisions that differ", "holds"],
        [row.row() for row in found],
    )
    columns = ["work", "CPU, ms", "GPU, ms", "CPU / GPU", "GPU memory, MiB"]
    show(f"Speed. {title}", columns, speed(device, wanted["least"]))
    rows = commands("gpu" if has_gpu else "cpu", wanted["samples"])
    columns = ["command", "exit status", "seconds", "GPU memory, MiB", "MPJPE"]
    show(f"Commands. {title}", columns, rows)
    if not all(row.holds for row in found) or any(row[1] != "0" for row in rows):
        sys.exit(1)


if __name__ == "__main__":
    main()
