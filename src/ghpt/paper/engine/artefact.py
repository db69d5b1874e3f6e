"""An artefact of the report, a table or a figure: the tasks it is made of, and what it makes of their
results.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from matplotlib.figure import Figure

from ghpt.paper.engine.setup import Setup
from ghpt.paper.engine.tasks import Task, read_json
from ghpt.report.tables import NONE, display_name, markdown

TOLERANCE = 0.05
"""A number that is worse than the paper's by more than this share of it is a miss."""


@dataclass(frozen=True)
class Spread:
    """A number over seeds."""

    values: tuple[float, ...]

    @property
    def mean(self) -> float:
        return statistics.fmean(self.values)

    @property
    def deviation(self) -> float | None:
        """Of a sample; None of one value."""
        return statistics.stdev(self.values) if len(self.values) > 1 else None

    def text(self, digits: int = 1) -> str:
        """``26.3`` of one seed, ``26.1 ± 0.2`` of several."""
        deviation = "" if self.deviation is None else f" ± {self.deviation:.{digits}f}"
        return f"{self.mean:.{digits}f}{deviation}"


def signed(value: float) -> str:
    """``+1.2``, ``-0.4``, and ``+0.0`` for what rounds to nothing."""
    return f"{round(value, 1) + 0.0:+.1f}"


def over_seeds(function: Callable[..., float], *spreads: Spread) -> Spread:
    """A function of several numbers, seed by seed."""
    return Spread(
        tuple(
            function(*values) for values in zip(*(spread.values for spread in spreads), strict=True)
        )
    )


@dataclass(frozen=True)
class Comparison:
    """One number of the paper beside ours."""

    what: str
    paper: float | None
    ours: Spread | None
    better: Literal["lower", "same"] = "lower"
    """``same``: there is no better, such as for the worst hypothesis; any large difference is a
    miss.
    """
    digits: int = 1

    @property
    def difference(self) -> float | None:
        """Ours against the paper's, as a share of the paper's."""
        return None if self.paper is None or self.ours is None else self.ours.mean / self.paper - 1

    @property
    def miss(self) -> bool:
        if self.difference is None:
            return False
        return (self.difference if self.better == "lower" else abs(self.difference)) > TOLERANCE

    def cells(self) -> list[str]:
        """*paper | ours | difference* as text; a miss is marked."""
        difference = (
            NONE
            if self.difference is None
            else f"{signed(100 * self.difference)} %{' (miss)' * self.miss}"
        )
        paper = NONE if self.paper is None else f"{self.paper:.{self.digits}f}"
        return [paper, NONE if self.ours is None else self.ours.text(self.digits), difference]


def comparison_table(rows: Sequence[Comparison], head: str, unit: str = "mm") -> str:
    """A Markdown table of *paper | ours | difference*."""
    return markdown(
        [head, f"paper, {unit}", f"ours, {unit}", "difference"],
        [[row.what, *row.cells()] for row in rows],
    )


@dataclass(frozen=True)
class Claim:
    """What the paper's text says, and whether our numbers say so too."""

    statement: str
    where: str
    """Section of the paper."""
    holds: bool | None
    """None where the data cannot tell: what others published of real images is no measure for
    synthetic data.
    """
    by: str
    """By how much, with the paper's own numbers where it has them."""

    def __post_init__(self) -> None:
        if self.holds is not None:  # numpy's own is no plain data
            object.__setattr__(self, "holds", bool(self.holds))


@dataclass(frozen=True)
class Section:
    """What an artefact shows."""

    data: str
    """The data used, in words that tell synthetic from real: goes into the heading."""
    body: str
    """Markdown. ``![caption](name.svg)`` shows ``figures["name"]``."""
    figures: Mapping[str, Figure] = field(default_factory=dict)
    comparisons: Sequence[Comparison] = ()
    """Every number that the paper prints, for the summary and the list of misses."""
    claims: Sequence[Claim] = ()
    explained: str = ""
    """What explains the misses of synthetic data, and the claims that do not hold; shown where
    there are any.
    """


class Results:
    """The results of an artefact's tasks, for each seed."""

    def __init__(
        self, setups: Sequence[Setup], tasks: Sequence[Mapping[str, Task]], folder: Path
    ) -> None:
        self.setups = setups
        self._tasks = tasks
        self._folder = folder

    @property
    def setup(self) -> Setup:
        """Of the first seed: data and sizes are those of all."""
        return self.setups[0]

    def paths(self, name: str) -> list[Path]:
        """The folder of a task for each seed."""
        return [tasks[name].folder(self._folder) for tasks in self._tasks]

    def read(self, name: str, file: str = "result.json") -> list[Any]:
        """A task's file for each seed."""
        key = (name, file)
        if key not in self._read:
            self._read[key] = [read_json(path / file) for path in self.paths(name)]
        return self._read[key]

    @cached_property
    def _read(self) -> dict[tuple[str, str], list[Any]]:
        return {}

    def spread(self, name: str, *keys: str, file: str = "metrics.json") -> Spread:
        """A number of a task's file, found by its keys, over the seeds."""
        values = []
        for content in self.read(name, file):
            for key in keys:
                content = content[key]
            values.append(float(content))
        return Spread(tuple(values))

    def relative(self, name: str, selection: str = "weight") -> Spread:
        """Pelvis-relative MPJPE (mm) of a selection or baseline in a test task."""
        return self.spread(name, "selections", selection, "mpjpe_relative")

    def display_name(self, data: str) -> str:
        return display_name(data, self.setup.source(data))

    def on_real(self, data: str, holds: bool) -> bool | None:
        """A claim about what others published: only real data can tell."""
        return None if self.setup.root(data) is None else holds


@dataclass(frozen=True)
class Artefact:
    """A table or figure of the paper, an ablation, or a robustness curve."""

    label: str
    """In paper.tex without ``tab:`` and ``fig:``, or our own."""
    kind: Literal["table", "figure", "ablation", "robustness"]
    title: str
    tasks: Callable[[Setup], dict[str, Task]]
    """By a name that ``section`` knows."""
    section: Callable[[Results], Section]
    of_paper: bool = True
    """False: a table or figure that the paper lacks; its heading has no ``tab:`` or ``fig:``."""
