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
from ghpt.models.aggregation import aggregation_weights
from ghpt.models.checkpoint import load_model
from ghpt.models.module import StochasticEstimator
from ghpt.paper.engine.actions import CHECKPOINT
from ghpt.recording import Observations, PoseEstimate
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
    model, _ = load_model(dependencies["model"] / CHECKPOINT, seed=config["seed"])
    everybody = together(model.eval(), estimators(config, model))
    perturbations = build(config["perturbations"], "perturbations")
    levels: list[dict[str, dict[str, MPJPE]]] = [{} for _ in perturbations]
    for first in range(0, len(frames), data.batch_size):
        batch = frames[range(first, min(first + data.batch_size, len(frames)))]
        for errors, perturbation in zip(levels, perturbations, strict=True):
            found = everybody(
                batch if perturbation is None else perturbation(batch, config["seed"])
            )
            for name, estimate in found.items():
                metrics = errors.setdefault(
                    name, {kind: MPJPE(kind, 1, len(JOINTS)) for kind in KINDS}
                )
                for metric in metrics.values():
                    metric.update(
                        estimate, batch.truth, batch.truth_valid, torch.zeros_like(batch.sample)
                    )
    content = [{name: _numbers(metrics) for name, metrics in errors.items()} for errors in levels]
    write_json(folder / "result.json", {"frames": len(frames), "levels": content})


def together(
    model: StochasticEstimator, others: Mapping[str, Estimator]
) -> Callable[[Observations], dict[str, PoseEstimate]]:
    """The model's selections and the other estimators on a batch, by name."""

    def estimate(batch: Observations) -> dict[str, PoseEstimate]:
        keys = model.keys("test", batch)
        pool = model.pool(batch, keys)
        weights = {
            n: aggregation_weights(n, pool.logits, pool.errors, model.temperature, keys)
            for n in OF_POOL
        }
        of_pool = {name: model.problem.aggregate(pool.hypotheses, w) for name, w in weights.items()}
        return of_pool | {name: estimator(batch) for name, estimator in others.items()}

    return estimate


def _numbers(metrics: dict[str, MPJPE]) -> dict[str, Any]:
    computed = {kind: metric.compute() for kind, metric in metrics.items()}
    means = {kind: _finite(errors.mean.item()) for kind, errors in computed.items()}
    return means | {"coverage": {kind: errors.coverage.item() for kind, errors in computed.items()}}


def _finite(value: float) -> float | None:
    """None where nothing was counted."""
    return value if math.isfinite(value) else None
