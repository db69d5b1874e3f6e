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
from ghpt.models.module import StochasticEstimator
from ghpt.models.problem import BaselineSettings
from ghpt.observations import Labelled, Observations, PoseEstimate, Truth
from ghpt.skeleton import JOINTS

KINDS: tuple[Kind, ...] = ("relative", "absolute")
OF_POOL = ("weight", "average", "most", "best")
"""Selections of the model's pool; the best one looks at the truth."""
LEARNED = (*OF_POOL, "view_weights", "frame_learned")
"""Every estimator that is not classical."""

Estimator = Callable[[Any], Any]
"""From observations to an estimate, as the problem of the model has them."""


@dataclass(frozen=True)
class CurveSettings:
    """The settings of `measure_curve`."""

    data: Target
    baselines: Mapping[str, Target]
    view_weights: Target
    seed: int
    perturbations: Sequence[Target | None]
    """None: the data as they are."""
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

    They are the model of the dependency ``model``, view weights and baselines. result.json:
    `CurveContent`.
    """
    own = settings(CurveSettings, config)
    data = build(own.data, "data")
    data.setup("test")
    frames = data.frames["test"]
    model, _ = load_model(dependencies["model"] / LAST, seed=own.seed)
    groups = BaselineSettings(own.baselines, {}, own.view_weights)
    estimate = all_estimators(model.eval(), model.problem.baselines(groups, model))
    perturbations = build(own.perturbations, "perturbations")
    levels = [LevelMetrics() for _ in perturbations]
    for first in range(0, len(frames), data.batch_size):
        batch = frames[range(first, min(first + data.batch_size, len(frames)))]
        for metrics, perturbation in zip(levels, perturbations, strict=True):
            observations = batch.observations
            if perturbation is not None:
                observations = perturbation(observations, own.seed)
            metrics.update(estimate(Labelled(observations, batch.truth)), batch.truth)
    content = CurveContent(len(frames), [metrics.compute() for metrics in levels])
    write_json(folder / "result.json", asdict(content))


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
