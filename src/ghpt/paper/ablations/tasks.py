"""The tasks of the ablations: a model with a setting changed, and its errors on validation and test
subjects.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from ghpt.paper.engine.artefact import Results, Spread
from ghpt.paper.engine.setup import Setup
from ghpt.paper.engine.tasks import Task

BASE = "h36m"
"""The data set that all are tested on."""
SETS = {"validation": "S8 (validation)", "test": "test"}
"""Split -> in tables."""
DEFAULT = "default"
CHANCE = 0.01
"""A smaller gain, as a share of the error, chooses nothing."""
NOTE = "Changes of a percent or so come with another training seed too and choose nothing."
_SELDOM = 4096
"""Every so many frames are validated in training, for these models are tested here."""


def trained(setup: Setup, data: str, *overrides: str, name: str, seconds: float = 16.0) -> Task:
    """A model with other settings than the default."""
    return setup.trained(data, *overrides, f"data.stride={_SELDOM}", name=name, seconds=seconds)


def evaluated(
    setup: Setup,
    model: Task,
    settings: Sequence[tuple[int | None, float | None]] = ((None, None),),
    splits: Iterable[str] = SETS,
    seconds: float = 5.0,
) -> Task:
    """A model on splits of Human3.6M, with other (hypotheses, temperature) where not None."""
    strides = setup.sizes["ablation"]["stride"]
    sets = {}
    for split in splits:
        own = (f"data.evaluate={split}", f"data.stride={strides[split]}")
        whole = setup.composed("test", BASE, *setup.overrides["test"], *own)
        sets[split] = whole["data"]
    config = {"sets": sets, "settings": [list(pair) for pair in settings], "seed": setup.seed}
    config |= {"files": whole["files"]} if "files" in whole else {}
    dependencies = {"model": model} | {split: setup.prepared(BASE, split) for split in splits}
    name = model.name.replace("train-pose", "ablation")
    return Task(
        name, "ghpt.paper.ablations.actions.evaluate", config, dependencies, seconds=seconds
    )


def number(
    results: Results, task: str, split: str, selection: str = "weight", setting: int = 0
) -> Spread:
    """Pelvis-relative MPJPE of an `evaluated` task, mm."""
    return Spread(tuple(float(each[split][setting][selection]) for each in results.read(task)))
