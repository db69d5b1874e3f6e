"""The tasks of the ablations: a model with a setting changed, and its errors on two splits."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict

from ghpt.paper.ablations.actions import PoolSetting, PoolsSettings
from ghpt.paper.engine.artefact import Results, Spread
from ghpt.paper.engine.setup import Setup
from ghpt.paper.engine.tasks import Task

ACTION = "ghpt.paper.ablations.actions.measure_pools"
BASE = "h36m"
"""The data set that all are tested on."""
SPLITS = {"validation": "S8 (validation)", "test": "test"}
"""Split -> its name in tables."""
DEFAULT = "default"
CHANCE = 0.01
"""A smaller gain, as a share of the error, chooses nothing."""
NOTE = "Changes of a percent or so come with another training seed too and choose nothing."
_SELDOM = 4096
"""Every so many frames are validated in training, for these models are tested here."""


def train_variant(
    setup: Setup, data: str, *overrides: str, name: str, seconds: float = 16.0
) -> Task:
    """Return the training of a model with other settings than the default."""
    stride = f"data.stride={_SELDOM}"
    return setup.training(data, *overrides, stride, name=name, seconds=seconds)


def evaluate_model(
    setup: Setup,
    model: Task,
    pools: Sequence[PoolSetting] = (PoolSetting(),),
    splits: Iterable[str] = SPLITS,
    seconds: float = 5.0,
) -> Task:
    """Return the test of a model on splits of Human3.6M, with each of the ``pools``."""
    data = {}
    files = {}
    dependencies = {"model": model}
    for split in splits:
        stride = f"data.stride={setup.sizes.ablation.stride[split]}"
        words = (*setup.overrides.test, f"data.evaluate={split}", stride)
        whole = setup.configuration("test", BASE, *words)
        data[split] = whole["data"]
        files = whole.get("files", {})
        dependencies[split] = setup.preparation(BASE, split)
    config = PoolsSettings(data, list(pools), setup.seed, files)
    name = model.name.replace("train-pose", "ablation")
    return Task(name, ACTION, asdict(config), dependencies, seconds=seconds)


def read_error(
    results: Results, task: str, split: str, selection: str = "weight", pool: int = 0
) -> Spread:
    """Return the pelvis-relative MPJPE (mm) of a selection in an `evaluate_model` task."""
    contents = results.read(task)
    return Spread(tuple(float(content[split][pool][selection]) for content in contents))
