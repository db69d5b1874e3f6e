"""Errors against a quantity, one line for each estimator: the figures of the robustness curves and
the ablations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, ScalarFormatter

from ghpt.paper.engine.artefact import Spread
from ghpt.report.figures import wrapped
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
    "view_weights": ("#000000", "-", "*"),
    "adaptive_ransac": ("#882255", (0, (5, 1, 1, 1)), "<"),
    "best": ("#999999", ":", "*"),
    "trained": ("#E69F00", "-.", "D"),
    "tested": ("#D55E00", "--", "s"),
}
LABELS = NAMES | {
    "weight": "the paper's selection",
    "view_weights": "learned view weights",
    "average": "average of its pool",
    "most": "best-scored of its pool",
    "best": "best of its pool (looks at the truth)",
}
WIDTHS = {"weight": 2.2, "view_weights": 2.6, "linear": 2.6, "ransac": 3.2, "adaptive_ransac": 4.0}
"""Of those that others often lie upon, or that matter most; 1.4 of the rest."""
ACROSS = 6.0
"""Largest ratio of the errors in a panel on a linear axis."""


@dataclass(frozen=True)
class Panel:
    """One pair of axes."""

    x: str
    """What is varied, with its unit."""
    lines: Mapping[str, tuple[Sequence[float | int], Sequence[Spread]]]
    """Estimator -> places, errors (mm)."""
    logarithmic: bool = False
    """The horizontal axis."""
    mark: float | int | None = None
    """The default, a vertical line."""


def curves(
    panels: Sequence[Panel],
    heading: str,
    y: str,
    labels: Mapping[str, str] = LABELS,
    share: bool = True,
) -> Figure:
    """The panels side by side, on one vertical axis where they ``share`` it; bars are a standard
    deviation over the seeds.
    """
    figure = Figure(figsize=(6.4 if len(panels) == 1 else 7.2, 4.6), layout="constrained")
    axes = figure.subplots(1, len(panels), sharey=share, squeeze=False)[0]
    for each, panel in zip(axes, panels, strict=True):
        _draw(each, panel, labels)
    errors = [s.mean for panel in panels for _, spreads in panel.lines.values() for s in spreads]
    errors = [error for error in errors if np.isfinite(error)]
    axes[0].set_ylabel(y)
    if errors and max(errors) > ACROSS * min(errors):
        axes[0].set_yscale("log")
        ticks = [
            t
            for t in (10, 15, 20, 30, 50, 70, 100, 150, 200, 300, 500, 700, 1000, 2000, 5000)
            if min(errors) / 1.5 < t < max(errors) * 1.5
        ]
        axes[0].yaxis.set_major_locator(FixedLocator(ticks))
        axes[0].yaxis.set_minor_locator(NullLocator())
        axes[0].yaxis.set_major_formatter(ScalarFormatter())
    handles = {h.get_label(): h for each in axes for h in each.get_legend_handles_labels()[0]}
    columns = 4 if max(map(len, handles)) <= 25 else 2
    figure.legend(
        handles.values(),
        handles,
        loc="outside lower center",
        ncols=columns,
        frameon=False,
        fontsize=9,
    )
    figure.suptitle(wrapped(heading, 70 if len(panels) == 1 else 80), fontsize=10)
    return figure


def _draw(axes: Axes, panel: Panel, labels: Mapping[str, str]) -> None:
    for name, (places, spreads) in panel.lines.items():
        colour, style, marker = STYLES[name]
        deviation = [s.deviation for s in spreads]
        axes.errorbar(
            places,
            [s.mean for s in spreads],
            yerr=None if None in deviation else deviation,
            color=colour,
            linestyle=style,
            marker=marker,
            markersize=4 + 1.5 * WIDTHS.get(name, 1.4),
            markeredgecolor="white",
            markeredgewidth=0.5,
            linewidth=WIDTHS.get(name, 1.4),
            capsize=2,
            label=labels.get(name, name),
            zorder=5 - WIDTHS.get(name, 1.4) / 4 + (name in ("weight", "view_weights")),
        )
    if panel.logarithmic:
        axes.set_xscale("log")
    ticks = sorted({place for places, _ in panel.lines.values() for place in places})
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    if panel.mark is not None:
        axes.axvline(panel.mark, color="#BBBBBB", linewidth=5, alpha=0.5, zorder=0, label="default")
    axes.set_xlabel(panel.x)
    axes.grid(axis="y", color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=9)
    axes.spines[["top", "right"]].set_visible(False)
