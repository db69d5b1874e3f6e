"""An artefact, a table or a figure of the report: the tasks behind it, and what it shows."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import matplotlib.figure

from ghpt.paper.engine.setup import Setup
from ghpt.paper.engine.tasks import Task, read_json
from ghpt.report.document import Block, Figure, Table, Text
from ghpt.report.tables import NONE, display_name

Number = int | float
"""A quantity that is varied: a count or a measure."""
TOLERANCE = 0.05
"""A number that is worse than the paper's by more than this share of it is a miss."""
FIGURES = "figures"
"""The folder of the figures, within the report's."""


@dataclass(frozen=True)
class Spread:
    """A number over seeds."""

    values: tuple[float, ...]

    @property
    def mean(self) -> float:
        return statistics.fmean(self.values)

    @property
    def deviation(self) -> float | None:
        """The standard deviation of the sample, None of one value."""
        return statistics.stdev(self.values) if len(self.values) > 1 else None

    def text(self, digits: int = 1) -> str:
        """Return ``26.3`` for one seed, ``26.1 ± 0.2`` for several."""
        mean = f"{self.mean:.{digits}f}"
        return mean if self.deviation is None else f"{mean} ± {self.deviation:.{digits}f}"


def format_signed(value: float) -> str:
    """Return ``+1.2``, ``-0.4``, and ``+0.0`` for what rounds to nothing."""
    return f"{round(value, 1) + 0.0:+.1f}"


def over_seeds(function: Callable[..., float], *spreads: Spread) -> Spread:
    """Apply a function of several numbers seed by seed."""
    values = zip(*(spread.values for spread in spreads), strict=True)
    return Spread(tuple(function(*of_seed) for of_seed in values))


@dataclass(frozen=True)
class Comparison:
    """A number of the paper beside ours."""

    label: str
    paper: float | None
    ours: Spread | None
    better: Literal["lower", "same"] = "lower"
    """``same``: there is no better, such as for the worst hypothesis, and any large difference is a
    miss.
    """
    digits: int = 1

    @property
    def difference(self) -> float | None:
        """The difference from the paper's number as a share of it, None where either is missing."""
        if self.paper is None or self.ours is None:
            return None
        return self.ours.mean / self.paper - 1

    @property
    def holds(self) -> bool | None:
        """Whether the number is no miss; None where the comparison is not decidable."""
        if self.difference is None:
            return None
        excess = self.difference if self.better == "lower" else abs(self.difference)
        return excess <= TOLERANCE

    @property
    def decidable(self) -> bool:
        return self.holds is not None

    @property
    def miss(self) -> bool:
        return self.holds is False

    def cells(self) -> list[str]:
        """Return the cells *paper*, *ours* and *difference* of a table; a miss is marked."""
        paper = NONE if self.paper is None else f"{self.paper:.{self.digits}f}"
        ours = NONE if self.ours is None else self.ours.text(self.digits)
        if self.difference is None:
            return [paper, ours, NONE]
        mark = " (miss)" if self.miss else ""
        return [paper, ours, f"{format_signed(100 * self.difference)} %{mark}"]


def comparison_table(comparisons: Sequence[Comparison], head: str) -> Table:
    """Return a table with a row *paper*, *ours*, *difference* for each comparison; mm."""
    rows = [[comparison.label, *comparison.cells()] for comparison in comparisons]
    return Table([head, "paper, mm", "ours, mm", "difference"], rows)


def comparison_rows(name: str, comparisons: Sequence[Comparison]) -> list[list[str]]:
    """Return the rows *paper*, *ours* and *difference*, with a column for each comparison."""
    kinds = ("paper", "ours", "difference")
    columns = zip(*(comparison.cells() for comparison in comparisons), strict=True)
    return [[f"{name}{kind}", *cells] for kind, cells in zip(kinds, columns, strict=True)]


@dataclass(frozen=True)
class Claim:
    """What the paper's text says, and whether our numbers say so too."""

    statement: str
    section: str
    """Section of the paper."""
    holds: bool | None
    """None where the data cannot decide: what others published of real images is no measure for
    synthetic data.
    """
    evidence: str
    """By how much, with the paper's own numbers where it has them."""

    def __post_init__(self) -> None:
        if self.holds is not None:  # NumPy's own booleans cannot be written as JSON
            object.__setattr__(self, "holds", bool(self.holds))

    @property
    def decidable(self) -> bool:
        return self.holds is not None


@dataclass(frozen=True)
class Section:
    """What an artefact shows."""

    data: str
    """The data used, in words that tell synthetic from real; the heading names them."""
    blocks: Sequence[Block]
    figures: Mapping[str, matplotlib.figure.Figure] = field(default_factory=dict)
    """By name; `figure_block` shows one."""
    comparisons: Sequence[Comparison] = ()
    """Every number that the paper prints, for the summary and the list of misses."""
    claims: Sequence[Claim] = ()
    explanation: Text = ""
    """What explains the misses of synthetic data and the claims that do not hold; it is shown where
    there are any.
    """


def figure_block(name: str, caption: str) -> Figure:
    """Return the block that shows a section's figure."""
    return Figure(figure_path(name, "svg"), caption)


def figure_path(name: str, kind: str) -> str:
    """Return a figure's path relative to the report's folder."""
    return f"{FIGURES}/{name}.{kind}"


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
        """The setup of the first seed: data and sizes are those of all."""
        return self.setups[0]

    def paths(self, name: str) -> list[Path]:
        """Return the folder of a task for each seed."""
        return [tasks[name].folder(self._folder) for tasks in self._tasks]

    def read(self, name: str, file: str = "result.json") -> list[Any]:
        """Return the content of a task's file for each seed."""
        key = (name, file)
        if key not in self._contents:
            self._contents[key] = [read_json(path / file) for path in self.paths(name)]
        return self._contents[key]

    @cached_property
    def _contents(self) -> dict[tuple[str, str], list[Any]]:
        return {}

    def numbers(self, name: str, *keys: str, file: str = "metrics.json") -> list[float | None]:
        """Return the number under the keys of a task's file for each seed, None for null."""
        values = []
        for content in self.read(name, file):
            for key in keys:
                content = content[key]
            values.append(None if content is None else float(content))
        return values

    def spread(self, name: str, *keys: str, file: str = "metrics.json") -> Spread:
        """Return a number of a task's file over the seeds. Raises TypeError where it is null."""
        return Spread(tuple(map(_number, self.numbers(name, *keys, file=file))))

    def relative(self, name: str, selection: str = "weight") -> Spread:
        """Return the pelvis-relative MPJPE (mm) of a selection or baseline in a test task."""
        return self.spread(name, "selections", selection, "mpjpe_relative")

    def selections(self, name: str) -> list[str]:
        """Return the selections and baselines of a test task."""
        return list(self.read(name, "metrics.json")[0]["selections"])

    def display_name(self, data: str) -> str:
        """Return the name of a data set in words that tell synthetic from real."""
        return display_name(data, self.setup.source(data))

    def on_real(self, data: str, holds: bool) -> bool | None:
        """Return ``holds`` on real data, None on synthetic ones.

        Only real data can decide a claim about what others published.
        """
        return None if self.setup.root(data) is None else holds


def _number(value: float | None) -> float:
    if value is None:
        raise TypeError("a number that every test has is null")
    return value


@dataclass(frozen=True)
class Artefact:
    """A table or figure of the paper, an ablation, or a robustness curve."""

    label: str
    """In paper.tex without ``tab:`` and ``fig:``, or our own."""
    kind: Literal["table", "figure", "ablation", "robustness"]
    title: str
    tasks: Callable[[Setup], dict[str, Task]]
    """Returns its tasks by a name that ``section`` knows."""
    section: Callable[[Results], Section]
    of_paper: bool = True
    """False for a table or figure that the paper lacks; its heading has no ``tab:`` or ``fig:``."""
