"""A robustness curve: what is varied, the tasks that measure it, and their results."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from ghpt.config import settings
from ghpt.paper.engine.artefact import Number, Results, Spread
from ghpt.paper.engine.settings import Robustness
from ghpt.paper.engine.setup import Setup
from ghpt.paper.engine.tasks import Task
from ghpt.paper.robustness.actions import (
    KINDS,
    NOT_CLASSICAL,
    OURS,
    CurveContent,
    CurveSettings,
    LevelErrors,
)

ACTION = "ghpt.paper.robustness.actions.measure_curve"
PERTURBATIONS = "ghpt.paper.robustness.perturbation"
CLEAN = "clean"
"""The task of a data set as it is, shared by the curves."""


@dataclass(frozen=True)
class Curve:
    """One quantity that gets worse."""

    name: str
    """The name of its task."""
    perturbation: str
    argument: str
    """The perturbation's argument that is varied."""
    levels_of: Callable[[Robustness], Sequence[Number]]
    """Returns the levels of the argument; 0 means the data as they are."""
    x: str
    """The axis and the head of the table, with the unit."""
    unit: str = ""
    """The unit in a sentence."""
    factor: float = 1.0
    """From the argument to what is shown."""
    data: str = "h36m"
    logarithmic: bool = False
    constants_of: Callable[[Robustness], Mapping[str, Number]] = lambda sizes: {}
    """Returns the perturbation's other arguments."""

    def levels(self, setup: Setup) -> Sequence[Number]:
        return self.levels_of(setup.sizes.robustness)

    def task(self, setup: Setup) -> Task:
        """Return the task that measures the levels other than 0."""
        constants = self.constants_of(setup.sizes.robustness)
        target = f"{PERTURBATIONS}.{self.perturbation}"
        perturbations = [
            {"_target_": target, self.argument: level, **constants}
            for level in self.levels(setup)
            if level
        ]
        return curve_task(setup, self.name, self.data, perturbations)


def curve_tasks(setup: Setup, curves: Sequence[Curve]) -> dict[str, Task]:
    """Return the tasks of some curves by name, with that of the unperturbed data."""
    tasks = {curve.name: curve.task(setup) for curve in curves}
    if any(0 in curve.levels(setup) for curve in curves):
        tasks[CLEAN] = curve_task(setup, CLEAN, "h36m", [None])
    return tasks


def curve_task(
    setup: Setup, name: str, data: str, perturbations: Sequence[Mapping[str, Any] | None]
) -> Task:
    """Return the task that measures every estimator under each of the perturbations."""
    sizes = setup.sizes.robustness
    whole = setup.configuration("test", data, *setup.overrides.test)
    config = CurveSettings(
        data=whole["data"],
        baselines=whole["baselines"],
        sequences=asdict(sizes.sequences["h36m" if data == "h36m" else "panoptic"]),
        trajectory=whole["trajectory"] and whole["trajectory"]["trajectory"],
        seed=setup.seed,
        perturbations=list(perturbations),
        files=whole.get("files", {}),
    )
    dependencies = {
        "model": setup.training(sizes.trained_on),
        "data": setup.preparation(data, "test"),
    }
    seconds = 2 + (10.0 if data == "h36m" else 8.0) * len(perturbations)
    name = f"robustness-{name}-seed{setup.seed}"
    return Task(name, ACTION, asdict(config), dependencies, seconds=seconds)


@dataclass(frozen=True)
class CurveResult:
    """The results of a curve."""

    levels: list[str]
    places: Sequence[Number]
    """The levels as numbers."""
    errors: Mapping[str, Mapping[str, Sequence[Spread]]]
    """Kind -> estimator -> MPJPE at each level, mm; NaN where nothing was measured."""
    coverage: Sequence[tuple[float, float]]
    """Smallest and largest share of the joints that an estimator has, at each level."""
    frames: int

    @property
    def last(self) -> int:
        """The index of the last level."""
        return len(self.levels) - 1

    @property
    def classical(self) -> list[str]:
        return [name for name in self.errors["relative"] if name not in NOT_CLASSICAL]

    @property
    def ours(self) -> list[str]:
        """Those of `OURS` that were measured."""
        return [name for name in OURS if name in self.errors["relative"]]

    def mean(self, name: str, level: int, kind: str = "relative") -> float:
        """Return the mean error of an estimator at a level, mm."""
        return self.errors[kind][name][level].mean

    def lead(self, name: str, level: int) -> float:
        """Return by what share an estimator's error is below that of the best classical one.

        NaN where nothing was measured.
        """
        return 1 - self.mean(name, level) / self.mean(self.best_classical(level), level)

    def leads(self, name: str) -> dict[int, float]:
        """Return the `lead` of an estimator at each level at which there is one."""
        leads = {level: self.lead(name, level) for level in range(len(self.levels))}
        return {level: lead for level, lead in leads.items() if math.isfinite(lead)}

    def best_classical(self, level: int) -> str:
        """Return the classical estimator with the smallest error at a level."""
        return min(self.classical, key=lambda name: nan_to_inf(self.mean(name, level)))


def nan_to_inf(error: float) -> float:
    """Return the error for an order in which what has no number comes last."""
    return math.inf if math.isnan(error) else error


def read_curve(results: Results, curve: Curve) -> CurveResult:
    """Return the results of a curve's task, with those of the unperturbed data at level 0."""
    levels = curve.levels(results.setup)
    contents = _contents(results, curve.name)
    seeds = [list(content.levels) for content in contents]
    if 0 in levels:
        for of_seed, clean in zip(seeds, _contents(results, CLEAN), strict=True):
            of_seed.insert(list(levels).index(0), clean.levels[0])
    places = [curve.factor * level for level in levels]
    return _as_result(seeds, places, contents[0].frames)


def read_task(results: Results, name: str) -> CurveResult:
    """Return the results of a task whose data are as they are."""
    contents = _contents(results, name)
    return _as_result([content.levels for content in contents], [0], contents[0].frames)


def _as_result(
    seeds: Sequence[Sequence[Mapping[str, LevelErrors]]], places: Sequence[Number], frames: int
) -> CurveResult:
    errors = {str(kind): _spreads(seeds, kind) for kind in KINDS}
    coverage = []
    for level in range(len(places)):
        shares = [
            estimator.coverage["relative"]
            for of_seed in seeds
            for estimator in of_seed[level].values()
        ]
        coverage.append((min(shares), max(shares)))
    labels = [f"{place:g}" for place in places]
    return CurveResult(labels, places, errors, coverage, frames)


def _contents(results: Results, task: str) -> list[CurveContent]:
    return [settings(CurveContent, content) for content in results.read(task)]


def _spreads(
    seeds: Sequence[Sequence[Mapping[str, LevelErrors]]], kind: str
) -> dict[str, list[Spread]]:
    """Return the error of each estimator at each level over the seeds; NaN where there is none."""
    spreads = {}
    for name in seeds[0][0]:
        spreads[name] = [
            Spread(tuple(levels[name].error(kind) for levels in of_level))
            for of_level in zip(*seeds, strict=True)
        ]
    return spreads
