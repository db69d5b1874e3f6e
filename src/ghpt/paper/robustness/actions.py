"""The action of the robustness curves: estimators on one data set under several perturbations."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from ghpt.config import Target, build, settings
from ghpt.files import write_json
from ghpt.metrics.pose_error import MPJPE, Kind
from ghpt.models.checkpoint import LAST, load_model
from ghpt.models.estimators.trajectory.estimator import Trajectory
from ghpt.models.module import StochasticEstimator
from ghpt.models.problem import BaselineSettings
from ghpt.observations import Labelled, Observations, PoseEstimate, Truth
from ghpt.paper.engine.settings import Sequences
from ghpt.paper.robustness.perturbation import Perturbation
from ghpt.paper.robustness.runs import Runs, draw_runs
from ghpt.skeleton import JOINTS

KINDS: tuple[Kind, ...] = ("relative", "absolute")
OF_POOL = ("weight", "average", "most", "best")
"""Selections of the model's pool; the best one looks at the truth."""
TRAJECTORY = "trajectory"
OURS = (TRAJECTORY, "frame_learned")
"""What the paper lacks, to be compared with the classical estimators of single frames."""
NOT_CLASSICAL = (*OF_POOL, *OURS)

Estimator = Callable[[Any], Any]
"""From observations to an estimate, as the problem of the model has them."""


@dataclass(frozen=True)
class CurveSettings:
    """The settings of `measure_curve`."""

    data: Target
    baselines: Mapping[str, Target]
    sequences: Mapping[str, int]
    """`Sequences`."""
    seed: int
    perturbations: Sequence[Target | None]
    """None: the data as they are."""
    trajectory: Target | None = None
    """How successive frames are estimated together; None: not at all."""
    files: Mapping[str, Any] = field(default_factory=dict)
    """What identifies the files of a real data set."""


@dataclass(frozen=True)
class LevelErrors:
    """The errors of an estimator under one perturbation, MPJPE in mm; None: nothing measured."""

    relative: float | None
    absolute: float | None
    coverage: Mapping[str, float]
    """Kind -> share of the joints with a truth that were measured."""

    def error(self, kind: str) -> float:
        """Return the error of a kind, NaN where nothing was measured."""
        value = self.relative if kind == "relative" else self.absolute
        return math.nan if value is None else value


@dataclass(frozen=True)
class CurveContent:
    """The content of result.json."""

    frames: int
    levels: Sequence[Mapping[str, LevelErrors]]
    """For each perturbation, the errors of each estimator by its name."""


class LevelMetrics:
    """The metrics of all estimators under one perturbation."""

    def __init__(self) -> None:
        self._metrics: dict[str, dict[Kind, MPJPE]] = {}

    def update(self, estimates: Mapping[str, PoseEstimate], truth: Truth) -> None:
        """Add the estimates of a batch, by the estimators' names."""
        for name, estimate in estimates.items():
            if name not in self._metrics:
                self._metrics[name] = {kind: MPJPE(kind, 1, len(JOINTS)) for kind in KINDS}
            group = torch.zeros(len(estimate.points), dtype=torch.int64)
            for metric in self._metrics[name].values():
                metric.update(estimate, truth, group)

    def compute(self) -> dict[str, LevelErrors]:
        """Return the errors over all batches."""
        return {name: _level_errors(metrics) for name, metrics in self._metrics.items()}


@torch.no_grad()
def measure_curve(config: dict[str, Any], dependencies: dict[str, Path], folder: Path) -> None:
    """Measure all estimators on the data under each of the perturbations; see `CurveSettings`.

    They are the model of the dependency ``model``, baselines and the trajectory.
    result.json: `CurveContent`.
    """
    own = settings(CurveSettings, config)
    data = build(own.data, "data")
    data.setup("test")
    runs = draw_runs(data.frames["test"].recordings, settings(Sequences, own.sequences))
    model, _ = load_model(dependencies["model"] / LAST, seed=own.seed)
    groups = BaselineSettings(own.baselines, {})
    estimate = all_estimators(model.eval(), model.problem.baselines(groups, model))
    trajectory = build(own.trajectory, "trajectory") if own.trajectory else None
    levels = [
        _measure_level(runs, perturbation, own.seed, estimate, trajectory, data.batch_size)
        for perturbation in build(own.perturbations, "perturbations")
    ]
    content = CurveContent(int(runs.tested.sum()), levels)
    write_json(folder / "result.json", asdict(content))


def _measure_level(
    runs: Runs,
    perturbation: Perturbation | None,
    seed: int,
    estimate: Callable[[Labelled[Observations, Truth]], dict[str, PoseEstimate]],
    trajectory: Trajectory | None,
    batch_size: int,
) -> dict[str, LevelErrors]:
    """Return the errors of all estimators in the frames of the runs that are tested."""
    observations = runs.batch.observations
    if perturbation is not None:
        observations = perturbation(observations, seed)
    tested = Labelled(observations, runs.batch.truth).rows(runs.tested)
    metrics = LevelMetrics()
    for first in range(0, len(tested), batch_size):
        batch = tested.rows(slice(first, first + batch_size))
        metrics.update(estimate(batch), batch.truth)
    if trajectory is not None:
        poses = runs.estimate(trajectory, observations).rows(runs.tested)
        metrics.update({TRAJECTORY: poses}, tested.truth)
    return metrics.compute()


def all_estimators(
    model: StochasticEstimator, others: Mapping[str, Estimator]
) -> Callable[[Labelled[Observations, Truth]], dict[str, PoseEstimate]]:
    """Return what estimates a batch by the model's selections and by the others, by name."""

    def estimate(batch: Labelled[Observations, Truth]) -> dict[str, PoseEstimate]:
        pool = model.sample(batch.observations, "test", batch.truth)
        estimates = {name: pool.estimate(name) for name in OF_POOL}
        for name, estimator in others.items():
            estimates[name] = estimator(batch.observations)
        return estimates

    return estimate


def _level_errors(metrics: Mapping[Kind, MPJPE]) -> LevelErrors:
    means = {}
    coverage = {}
    for kind, metric in metrics.items():
        errors = metric.compute()
        mean = errors.mean.item()
        means[kind] = mean if math.isfinite(mean) else None
        coverage[str(kind)] = errors.coverage.item()
    return LevelErrors(means["relative"], means["absolute"], coverage)
