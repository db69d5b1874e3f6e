"""Errors against a quantity, a line for each estimator: figures of robustness and ablations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, ScalarFormatter

from ghpt.paper.engine.artefact import Number, Spread
from ghpt.report.figures import wrap_lines
from ghpt.report.tables import NAMES

# Okabe and Ito's palette, and Tol's wine; told apart in grey print by dashes and markers.
STYLES = {
    "weight": ("#0072B2", "-", "o"),
    "average": ("#56B4E9", (0, (4, 1)), "v"),
    "linear": ("#D55E00", "--", "s"),
    "weighted_linear": ("#E69F00", "-.", "D"),
    "ransac": ("#009E73", (0, (1, 1)), "^"),
    "m_estimator": ("#CC79A7", (0, (3, 1, 1, 1, 1, 1)), "P"),
    "lo_ransac": ("#666666", (0, (6, 2)), "X"),
    "adaptive_ransac": ("#882255", (0, (5, 1, 1, 1)), "<"),
    "frame_learned": ("#117733", "-", "p"),
    "trajectory": ("#CC3311", "-", "h"),
    "best": ("#999999", ":", "*"),
    "trained": ("#E69F00", "-.", "D"),
    "tested": ("#D55E00", "--", "s"),
}
LABELS = NAMES | {
    "weight": "the paper's selection",
    "trajectory": "trajectories",
    "frame_learned": "learned frames",
    "average": "average of its pool",
    "most": "best-scored of its pool",
    "best": "best of its pool (looks at the truth)",
}
WIDTHS = {
    "weight": 2.2,
    "trajectory": 2.6,
    "frame_learned": 2.2,
    "linear": 2.6,
    "ransac": 3.2,
    "adaptive_ransac": 4.0,
}
"""Widths of the lines that others often lie upon, or that matter most."""
OTHER_WIDTH = 1.4
_IN_FRONT = ("weight", "trajectory", "frame_learned")
ACROSS = 6.0
"""Largest ratio of the errors in a panel on a linear axis."""
TICKS = (10, 15, 20, 30, 50, 70, 100, 150, 200, 300, 500, 700, 1000, 2000, 5000)
"""Ticks of a logarithmic axis, mm."""


@dataclass(frozen=True)
class Line:
    """The errors of an estimator at some places."""

    places: Sequence[Number]
    errors: Sequence[Spread]
    """mm."""


@dataclass(frozen=True)
class Panel:
    """One pair of axes."""

    x: str
    """What is varied, with its unit."""
    lines: Mapping[str, Line]
    """By the estimator's name."""
    logarithmic: bool = False
    """Whether the horizontal axis is logarithmic."""
    mark: Number | None = None
    """The default, a vertical line."""


def draw_curves(
    panels: Sequence[Panel],
    heading: str,
    y: str,
    labels: Mapping[str, str] = LABELS,
    share: bool = True,
) -> Figure:
    """Draw the panels side by side, on one vertical axis where they ``share`` it.

    Bars are a standard deviation over the seeds.
    """
    single = len(panels) == 1
    figure = Figure(figsize=(6.4 if single else 7.2, 4.6), layout="constrained")
    axes = list(figure.subplots(1, len(panels), sharey=share, squeeze=False)[0])
    for own_axes, panel in zip(axes, panels, strict=True):
        _draw_panel(own_axes, panel, labels)
    axes[0].set_ylabel(y)
    _scale_errors(axes[0], panels)
    _draw_legend(figure, axes)
    figure.suptitle(wrap_lines(heading, 70 if single else 80), fontsize=10)
    return figure


def _scale_errors(axes: Axes, panels: Sequence[Panel]) -> None:
    """Make the vertical axis logarithmic where the errors differ by more than ``ACROSS``."""
    lines = [line for panel in panels for line in panel.lines.values()]
    means = [error.mean for line in lines for error in line.errors]
    errors = [mean for mean in means if np.isfinite(mean)]
    if not errors or max(errors) <= ACROSS * min(errors):
        return
    axes.set_yscale("log")
    ticks = [tick for tick in TICKS if min(errors) / 1.5 < tick < max(errors) * 1.5]
    axes.yaxis.set_major_locator(FixedLocator(ticks))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(ScalarFormatter())


def _draw_legend(figure: Figure, axes: Sequence[Axes]) -> None:
    handles: dict[str, Artist] = {}
    for own_axes in axes:
        for handle, label in zip(*own_axes.get_legend_handles_labels(), strict=True):
            handles[label] = handle
    figure.legend(
        handles.values(),
        handles,
        loc="outside lower center",
        ncols=4 if max(map(len, handles)) <= 25 else 2,
        frameon=False,
        fontsize=9,
    )


def _draw_panel(axes: Axes, panel: Panel, labels: Mapping[str, str]) -> None:
    for name, line in panel.lines.items():
        _draw_line(axes, name, line, labels.get(name, name))
    if panel.logarithmic:
        axes.set_xscale("log")
    ticks = sorted({place for line in panel.lines.values() for place in line.places})
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    if panel.mark is not None:
        axes.axvline(panel.mark, color="#BBBBBB", linewidth=5, alpha=0.5, zorder=0, label="default")
    axes.set_xlabel(panel.x)
    axes.grid(axis="y", color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=9)
    axes.spines[["top", "right"]].set_visible(False)


def _draw_line(axes: Axes, name: str, line: Line, label: str) -> None:
    colour, style, marker = STYLES[name]
    width = WIDTHS.get(name, OTHER_WIDTH)
    deviations = [error.deviation for error in line.errors]
    known = [deviation for deviation in deviations if deviation is not None]
    axes.errorbar(
        line.places,
        [error.mean for error in line.errors],
        yerr=known if len(known) == len(deviations) else None,
        color=colour,
        linestyle=style,
        marker=marker,
        markersize=4 + 1.5 * width,
        markeredgecolor="white",
        markeredgewidth=0.5,
        linewidth=width,
        capsize=2,
        label=label,
        zorder=5 - width / 4 + (name in _IN_FRONT),
    )
