"""A robustness curve: what is varied, the tasks that measure it, and their results."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from ghpt.paper.engine.artefact import Results, Spread
from ghpt.paper.engine.setup import Setup
from ghpt.paper.engine.tasks import Task
from ghpt.paper.robustness.actions import LEARNED

PERTURBATIONS = "ghpt.paper.robustness.perturbation"
CLEAN = "clean"
"""The task of a data set as it is, shared by the curves."""


@dataclass(frozen=True)
class Curve:
    """One quantity that gets worse."""

    name: str
    """Of its task, and of its levels in ``sizes.robustness``; 0 means the data as they are."""
    perturbation: str
    setting: str
    """The perturbation's argument that the levels are of."""
    x: str
    """The axis and the head of the table, with the unit."""
    unit: str = ""
    """In a sentence."""
    times: float = 1.0
    """From the setting to what is shown."""
    data: str = "h36m"
    logarithmic: bool = False
    more: tuple[str, ...] = field(default=())
    """Further arguments, also in ``sizes.robustness``."""

    def levels(self, setup: Setup) -> list[float | int]:
        return setup.sizes["robustness"][self.name]

    def task(self, setup: Setup) -> Task:
        sizes = setup.sizes["robustness"]
        more = {name: sizes[f"{self.name}_{name}"] for name in self.more}
        target = f"{PERTURBATIONS}.{self.perturbation}"
        perturbations = [
            {"_target_": target, self.setting: level, **more}
            for level in self.levels(setup)
            if level
        ]
        return measured(setup, self.name, self.data, perturbations)


def measured(
    setup: Setup, name: str, data: str, perturbations: Sequence[dict[str, Any] | None]
) -> Task:
    """Everybody under each of the perturbations."""
    sizes = setup.sizes["robustness"]
    whole = setup.composed(
        "test", data, *setup.overrides["test"], f"data.stride={sizes['stride'][data]}"
    )
    config = {
        key: whole[key]
        for key in ("data", "view_weights", "baselines", "seed", "files")
        if key in whole
    }
    config |= {"perturbations": list(perturbations)}
    dependencies = {
        "model": setup.trained(sizes["trained_on"]),
        "data": setup.prepared(data, "test"),
    }
    seconds = 2 + (5.0 if data == "h36m" else 3.5) * len(perturbations)
    name = f"robustness-{name}-seed{setup.seed}"
    return Task(name, "ghpt.paper.robustness.actions.curve", config, dependencies, seconds=seconds)


def tasks_of(setup: Setup, of: Sequence[Curve]) -> dict[str, Task]:
    tasks = {curve.name: curve.task(setup) for curve in of}
    if any(0 in curve.levels(setup) for curve in of):
        tasks[CLEAN] = measured(setup, CLEAN, "h36m", [None])
    return tasks


@dataclass(frozen=True)
class Found:
    """The results of a curve."""

    levels: list[str]
    places: list[float]
    errors: dict[str, dict[str, list[Spread]]]
    """Kind -> estimator -> MPJPE at each level, mm; NaN where nothing was counted."""
    coverage: list[tuple[float, float]]
    """Least and largest share of the joints that an estimator has, at each level."""

    @property
    def classical(self) -> list[str]:
        return [name for name in self.errors["relative"] if name not in LEARNED]

    def mean(self, name: str, level: int, kind: str = "relative") -> float:
        return self.errors[kind][name][level].mean

    def lead(self, name: str, level: int) -> float:
        """By what share an estimator's error is below that of the best classical one."""
        return 1 - self.mean(name, level) / self.mean(self.best_classical(level), level)

    def best_classical(self, level: int) -> str:
        return min(self.classical, key=lambda name: nan_to_last(self.mean(name, level)))


def nan_to_last(error: float) -> float:
    """For an order in which what has no number comes last."""
    return math.inf if math.isnan(error) else error


def found(results: Results, curve: Curve) -> Found:
    levels = curve.levels(results.setup)
    seeds = [list(each["levels"]) for each in results.read(curve.name)]
    for i, level in enumerate(levels):
        if level == 0:
            for own, clean in zip(seeds, results.read(CLEAN), strict=True):
                own.insert(i, clean["levels"][0])
    names = list(seeds[0][0])

    def spread(kind: str, name: str, i: int) -> Spread:
        values = (own[i][name][kind] for own in seeds)
        return Spread(tuple(float("nan") if value is None else value for value in values))

    errors = {
        kind: {name: [spread(kind, name, i) for i in range(len(levels))] for name in names}
        for kind in ("relative", "absolute")
    }
    shares = [
        [own[i][name]["coverage"]["relative"] for own in seeds for name in names]
        for i in range(len(levels))
    ]
    return Found(
        [f"{curve.times * level:g}" for level in levels],
        [curve.times * level for level in levels],
        errors,
        [(min(s), max(s)) for s in shares],
    )
