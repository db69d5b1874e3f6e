"""The sweep over the number of frames (fig:comparison-to-8-point), as a figure and a table."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ghpt.report.document import Table
from ghpt.report.figures import wrap_lines
from ghpt.report.pair_figures import METHOD_STYLES, OTHER_STYLE
from ghpt.report.pair_tables import NAMES
from ghpt.report.tables import NONE

CLIP = 80.0
"""mm at which fig:comparison-to-8-point is cut."""
_BANDS = ("weight", "eight_point")
"""The two of the paper's figure; the bands of others are fainter, so that many can be told apart.
"""

Sweep = Mapping[str, Mapping[int, Sequence[float]]]
"""Method -> M -> E_3D (mm; inf where it failed) of the repeats."""


@dataclass(frozen=True)
class Statistics:
    """Statistics of the repeats at one M; NaN where there are none, not finite where one failed."""

    mean: float
    deviation: float
    """The standard deviation of the sample, 0 of one repeat."""
    median: float

    @classmethod
    def from_values(cls, values: Sequence[float]) -> Statistics:
        """Return the statistics of some repeats."""
        array = np.array(values, dtype=np.float64)
        if not len(array):
            return cls(np.nan, np.nan, np.nan)
        deviation = 0.0
        if not np.isfinite(array).all():
            deviation = np.nan
        elif len(array) > 1:
            deviation = float(array.std(ddof=1))
        return cls(float(array.mean()), deviation, float(np.median(array)))


Statistic = Callable[[Statistics], float]


def frames_sweep(sweep: Sweep, heading: str) -> Figure:
    """Draw fig:comparison-to-8-point: mean E_3D over the repeats against M, cut at ``CLIP`` mm.

    The bands are one standard deviation wide to both sides.
    """
    figure = Figure(figsize=(6.4, 4.4), layout="constrained")
    axes = figure.subplots()
    for name, by_frames in sweep.items():
        _draw_method(axes, name, by_frames)
    axes.set(
        xlabel="frames M",
        ylabel=f"$E_{{3D}}$, mm (cut at {CLIP:.0f})",
        xticks=_all_frames([sweep]),
        ylim=(0, CLIP * 1.02),
    )
    axes.grid(axis="y", color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title(wrap_lines(heading, 75), fontsize=10)
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def _draw_method(axes: Axes, name: str, by_frames: Mapping[int, Sequence[float]]) -> None:
    style = METHOD_STYLES.get(name, OTHER_STYLE)
    frames = sorted(by_frames)
    statistics = [Statistics.from_values(by_frames[m]) for m in frames]
    mean = np.array([of_frames.mean for of_frames in statistics])
    deviation = np.array([of_frames.deviation for of_frames in statistics])
    low = _clip(mean - deviation)
    high = _clip(mean + deviation)
    alpha = 0.2 if name in _BANDS else 0.08
    axes.fill_between(frames, low, high, color=style.colour, alpha=alpha, linewidth=0)
    axes.plot(
        frames,
        np.minimum(mean, CLIP),
        color=style.colour,
        linestyle=style.line,
        marker=style.marker,
        markersize=5,
        markeredgecolor="white",
        markeredgewidth=0.6,
        linewidth=1.8,
        label=NAMES.get(name, name),
        zorder=4 if name == "weight" else 3,
    )


def _clip(errors: np.ndarray) -> np.ndarray:
    """Return the errors between 0 and ``CLIP``; what is not finite is at ``CLIP``."""
    return np.clip(np.nan_to_num(errors, nan=np.inf, posinf=np.inf), 0, CLIP)


def _all_frames(sweeps: Iterable[Sweep]) -> list[int]:
    """Return every M of the sweeps in order."""
    return sorted({m for sweep in sweeps for by_frames in sweep.values() for m in by_frames})


def sweep_table(sweep: Sweep) -> Table:
    """Return a table M x method of E_3D, mm: mean ± deviation (median), a dash where one failed."""
    rows = []
    for m in _all_frames([sweep]):
        cells = [_cell(by_frames.get(m, ())) for by_frames in sweep.values()]
        rows.append([str(m), *cells])
    return Table(["M", *(NAMES.get(name, name) for name in sweep)], rows)


def _cell(values: Sequence[float]) -> str:
    if not len(values):
        return NONE
    statistics = Statistics.from_values(values)
    mean = _number(statistics.mean)
    deviation = _number(statistics.deviation)
    return f"{mean} ± {deviation} ({_number(statistics.median)})"


def _number(value: float) -> str:
    return f"{value:.1f}" if np.isfinite(value) else NONE


def pairs_table(sweeps: Mapping[str, Sweep], methods: Sequence[str]) -> Table:
    """Return the medians of E_3D (mm) of some methods, by M and pair.

    A star stands where the first method is not below all others.
    """
    rows = []
    for m in _all_frames(sweeps.values()):
        cells = []
        for sweep in sweeps.values():
            medians = [Statistics.from_values(sweep[method][m]).median for method in methods]
            best = all(medians[0] < other for other in medians[1:])
            numbers = " / ".join(map(_number, medians))
            cells.append(numbers if best else f"{numbers} *")
        rows.append([str(m), *cells])
    return Table(["M", *sweeps], rows)


def count_wins(sweeps: Iterable[Sweep], ours: str, other: str, statistic: Statistic) -> int:
    """Return for how many sweeps and M a statistic of one method is below another's."""
    count = 0
    for sweep in sweeps:
        for m, values in sweep[ours].items():
            won = statistic(Statistics.from_values(values)) < statistic(
                Statistics.from_values(sweep[other][m])
            )
            count += won
    return count
