"""The work of the robustness curves: estimators on one data set under each of several
perturbations.
"""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from ghpt.config import build
from ghpt.files import write_json
from ghpt.metrics.pose_error import MPJPE
from ghpt.models.checkpoint import LAST, load_model
from ghpt.models.module import StochasticEstimator
from ghpt.observations import Labelled, Observations, PoseEstimate, Truth
from ghpt.report.poses import estimators
from ghpt.skeleton import JOINTS

KINDS = ("relative", "absolute")
OF_POOL = ("weight", "average", "most", "best")
"""Selections of the model's pool; the best one looks at the truth."""
LEARNED = (*OF_POOL, "view_weights")
"""Every estimator that is not classical."""

Estimator = Callable[[Observations], PoseEstimate]


@torch.no_grad()
def curve(config: dict[str, Any], dependencies: dict[str, Path], folder: Path) -> None:
    """Estimate ``config["data"]`` under each of ``config["perturbations"]`` (None: as it is) with
    the model of ``dependencies["model"]``, ``config["view_weights"]`` and ``config["baselines"]``.

    result.json: for each perturbation, estimator -> MPJPE (mm) ``relative`` and ``absolute``, and
    the ``coverage`` of each: the share of the joints with a truth that were counted.
    """
    data = build(config["data"], "data")
    data.setup("test")
    frames = data.frames["test"]
    model, _ = load_model(dependencies["model"] / LAST, seed=config["seed"])
    everybody = together(model.eval(), estimators(config, model))
    perturbations = build(config["perturbations"], "perturbations")
    levels: list[dict[str, dict[str, MPJPE]]] = [{} for _ in perturbations]
    for first in range(0, len(frames), data.batch_size):
        batch = frames[range(first, min(first + data.batch_size, len(frames)))]
        for errors, perturbation in zip(levels, perturbations, strict=True):
            observations = batch.observations
            if perturbation is not None:
                observations = perturbation(observations, config["seed"])
            found = everybody(Labelled(observations, batch.truth))
            for name, estimate in found.items():
                metrics = errors.setdefault(
                    name, {kind: MPJPE(kind, 1, len(JOINTS)) for kind in KINDS}
                )
                for metric in metrics.values():
                    metric.update(estimate, batch.truth, torch.zeros_like(observations.index))
    content = [{name: _numbers(metrics) for name, metrics in errors.items()} for errors in levels]
    write_json(folder / "result.json", {"frames": len(frames), "levels": content})


def together(
    model: StochasticEstimator, others: Mapping[str, Estimator]
) -> Callable[[Labelled[Observations, Truth]], dict[str, PoseEstimate]]:
    """The model's selections and the other estimators on a batch, by name."""

    def estimate(batch: Labelled[Observations, Truth]) -> dict[str, PoseEstimate]:
        pool = model.sample(batch.observations, "test", batch.truth)
        of_pool = {name: pool.estimate(name) for name in OF_POOL}
        return of_pool | {name: estimator(batch.observations) for name, estimator in others.items()}

    return estimate


def _numbers(metrics: dict[str, MPJPE]) -> dict[str, Any]:
    computed = {kind: metric.compute() for kind, metric in metrics.items()}
    means = {kind: _finite(errors.mean.item()) for kind, errors in computed.items()}
    return means | {"coverage": {kind: errors.coverage.item() for kind, errors in computed.items()}}


def _finite(value: float) -> float | None:
    """None where nothing was counted."""
    return value if math.isfinite(value) else None
