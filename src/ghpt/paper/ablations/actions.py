"""The action of the ablations: a model's selections at several pool sizes and temperatures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from ghpt.config import Target, build, settings
from ghpt.data.datasets.frames import Frames
from ghpt.files import write_json
from ghpt.metrics.pose_error import MPJPE
from ghpt.models.checkpoint import LAST, load_model
from ghpt.models.module import StochasticEstimator
from ghpt.skeleton import JOINTS

SELECTIONS = ("weight", "average", "best")


@dataclass(frozen=True)
class PoolSetting:
    """A number of hypotheses and a temperature; None: the model's own."""

    hypotheses: int | None = None
    temperature: float | None = None


@dataclass(frozen=True)
class PoolsSettings:
    """The settings of `measure_pools`."""

    splits: Mapping[str, Target]
    """A DataModule by a split's name."""
    pools: Sequence[PoolSetting]
    seed: int
    files: Mapping[str, Any] = field(default_factory=dict)
    """What identifies the files of a real data set."""


@torch.no_grad()
def measure_pools(config: dict[str, Any], dependencies: dict[str, Path], folder: Path) -> None:
    """Test the model of the dependency ``model`` on each split with each pool.

    See `PoolsSettings`. result.json: split -> for each pool, selection -> pelvis-relative MPJPE
    (mm). A smaller pool is the beginning of a larger one, the same that test.py draws with so many
    hypotheses.
    """
    own = settings(PoolsSettings, config)
    model, _ = load_model(dependencies["model"] / LAST, seed=own.seed)
    model.eval()
    result = {}
    for name, split in own.splits.items():
        data = build(split, "data")
        data.setup("test")
        result[name] = measure_frames(model, data.frames["test"], own.pools, data.batch_size)
    write_json(folder / "result.json", result)


def measure_frames(
    model: StochasticEstimator, frames: Frames, pools: Sequence[PoolSetting], batch_size: int
) -> list[dict[str, float]]:
    """Return the pelvis-relative MPJPE (mm) of the selections with each pool."""
    metrics = [_PoolMetrics(model, pool) for pool in pools]
    model.hypotheses = max(of_pool.hypotheses for of_pool in metrics)
    for first in range(0, len(frames), batch_size):
        batch = frames[range(first, min(first + batch_size, len(frames)))]
        pool = model.sample(batch.observations, "test", batch.truth)
        group = torch.zeros_like(batch.observations.index)
        for of_pool in metrics:
            part = pool.first(of_pool.hypotheses).with_temperature(of_pool.temperature)
            for name, metric in of_pool.metrics.items():
                metric.update(part.estimate(name), batch.truth, group)
    return [of_pool.compute() for of_pool in metrics]


class _PoolMetrics:
    """The errors of the selections with one pool."""

    def __init__(self, model: StochasticEstimator, pool: PoolSetting) -> None:
        self.hypotheses = pool.hypotheses or model.hypotheses
        self.temperature = pool.temperature or model.temperature
        self.metrics = {name: MPJPE("relative", 1, len(JOINTS)) for name in SELECTIONS}

    def compute(self) -> dict[str, float]:
        return {name: metric.compute().mean.item() for name, metric in self.metrics.items()}
