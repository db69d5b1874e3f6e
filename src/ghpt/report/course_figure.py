"""A recording over time: errors of the views, states of the joints, lengths of the limbs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from ghpt.geometry.state import FILE_STATES, State
from ghpt.report.course import Course
from ghpt.report.figures import LEFT, RIGHT
from ghpt.skeleton import JOINT

_STATE_COLOURS = {
    State.OBSERVED: "#56B4E9",
    State.SUPPORTED: "#009E73",
    State.FILLED: "#F0E442",
    State.FEW_VIEWS: "#BBBBBB",
    State.PARALLEL: "#CC79A7",
    State.BEHIND: "#0072B2",
    State.BAD_INPUT: "#888888",
    State.REJECTED: "#D55E00",
}
_MOST_LABELS = 35
_MOST_HEIGHT = 7.0
"""Inches of a strip."""
_ROW = 0.17
"""Inches of a view or a joint in a strip."""
_DARK = 4.0
"""An error of so many medians is dark, or a larger one: noise is to look harmless."""
_LIMBS = {
    "thigh": ("hip", "knee"),
    "shank": ("knee", "ankle"),
    "upper arm": ("shoulder", "elbow"),
    "forearm": ("elbow", "wrist"),
}
LIMBS = tuple(
    (JOINT[f"{side}_{start}"], JOINT[f"{side}_{end}"])
    for start, end in _LIMBS.values()
    for side in ("left", "right")
)
"""The pairs of the 17 joints whose distances `course_figure` draws."""


@dataclass(frozen=True)
class ViewCourse:
    """Errors of V views in F frames."""

    names: tuple[str, ...]
    frame: Float[np.ndarray, " F"]
    error: Float[np.ndarray, "F V"]
    """Median over the joints, pixels; NaN where nothing is measured."""


def course_figure(
    views: ViewCourse, course: Course, joints: tuple[str, ...], rate_hz: float | None
) -> Figure:
    """Return the figure, over seconds where the frame rate is known."""
    heights = [_height(len(views.names)), _height(len(joints))]
    if course.length.shape[1]:
        heights.append(1.9)
    figure = Figure(figsize=(10.5, sum(heights) + 0.75 * len(heights)), layout="constrained")
    panels = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights, squeeze=False)
    axes = panels[:, 0]
    first = float(course.frame[0])
    last = max(float(course.frame[-1]), float(views.frame[-1]) if len(views.frame) else 0.0) + 1
    unit = rate_hz or 1.0
    span = (first / unit, last / unit)
    _draw_errors(figure, axes[0], views, (first, last), span)
    _draw_states(axes[1], course, joints, span)
    if len(axes) > 2:
        _draw_lengths(axes[2], course, unit)
    axes[-1].set_xlabel("time, s" if rate_hz else "frame")
    axes[-1].set_xlim(span)
    for each in axes:
        each.spines[["top", "right"]].set_visible(False)
        each.tick_params(labelsize=8)
    return figure


def _height(rows: int) -> float:
    return min(max(_ROW * rows, 0.6), _MOST_HEIGHT)


def _draw_errors(
    figure: Figure,
    axes: Axes,
    views: ViewCourse,
    frames: tuple[float, float],
    span: tuple[float, float],
) -> None:
    """Draw a row for each view, whose colour is the error of the column's frames."""
    axes.set_title("Error of each view in what the others give, px", loc="left", fontsize=10)
    _name_rows(axes, views.names)
    columns = _column_means(views, frames)
    if np.isnan(columns).all():
        axes.text(0.5, 0.5, "not measured", transform=axes.transAxes, ha="center", va="center")
        return
    largest = max(float(np.nanquantile(columns, 0.98)), _DARK * float(np.nanmedian(columns)), 1.0)
    extent = (*span, len(views.names) - 0.5, -0.5)
    shown = axes.imshow(
        columns.T,
        aspect="auto",
        extent=extent,
        interpolation="nearest",
        cmap="YlOrRd",
        vmin=0,
        vmax=largest,
    )
    bar = figure.colorbar(shown, ax=axes, pad=0.01, fraction=0.03, extend="max")
    bar.ax.tick_params(labelsize=8)


def _column_means(views: ViewCourse, frames: tuple[float, float]) -> Float[np.ndarray, "C V"]:
    """Return the mean error in columns of the time; NaN where no frame was measured."""
    first, last = frames
    count = max(1, min(200, len(views.frame)))
    column = ((views.frame - first) / (last - first) * count).astype(int).clip(0, count - 1)
    total = np.zeros((count, len(views.names)))
    measured = np.zeros_like(total)
    np.add.at(total, column, np.nan_to_num(views.error))
    np.add.at(measured, column, np.isfinite(views.error))
    return np.where(measured > 0, total / np.maximum(measured, 1), np.nan)


def _draw_states(
    axes: Axes, course: Course, joints: tuple[str, ...], span: tuple[float, float]
) -> None:
    axes.set_title("State of each joint, the worst of a column's frames", loc="left", fontsize=10)
    _name_rows(axes, tuple(joint.replace("_", " ") for joint in joints))
    colours = ListedColormap([_STATE_COLOURS[state] for state in FILE_STATES])
    axes.imshow(
        course.state.numpy().T,
        aspect="auto",
        extent=(*span, len(joints) - 0.5, -0.5),
        interpolation="nearest",
        cmap=colours,
        vmin=-0.5,
        vmax=len(FILE_STATES) - 0.5,
    )
    present = set(np.unique(course.state.numpy()).tolist())
    handles = [
        Patch(color=_STATE_COLOURS[state], label=state.words)
        for state in FILE_STATES
        if state in present
    ]
    axes.legend(
        handles=handles,
        loc="lower right",
        bbox_to_anchor=(1, 1),
        ncols=len(handles),
        frameon=False,
        fontsize=8,
        borderpad=0,
    )


def _name_rows(axes: Axes, names: tuple[str, ...]) -> None:
    """Write the names of the rows, of many only some."""
    step = -(-len(names) // _MOST_LABELS)
    places = range(0, len(names), step)
    axes.set_yticks(list(places), [names[place] for place in places], parse_math=False)
    axes.set_ylim(len(names) - 0.5, -0.5)


def _draw_lengths(axes: Axes, course: Course, unit: float) -> None:
    """Draw the lengths of the limbs: left and right should be as long, and stay so."""
    axes.set_title("Length of each limb, mm", loc="left", fontsize=10)
    time = course.frame / unit
    lengths = course.length.numpy()
    for side, colour in enumerate((LEFT, RIGHT)):
        axes.plot(time, lengths[:, side::2], color=colour, linewidth=1.0)
    if np.isfinite(lengths).any():
        largest = 1.15 * float(np.nanquantile(lengths, 0.98))
        axes.set_ylim(0, largest)
        _name_limbs(axes, lengths, 0.1 * largest)
    handles = [Patch(color=LEFT, label="left"), Patch(color=RIGHT, label="right")]
    axes.legend(
        handles=handles,
        loc="lower right",
        bbox_to_anchor=(1, 1),
        ncols=2,
        frameon=False,
        fontsize=8,
        borderpad=0,
    )
    axes.grid(axis="y", color="#DDDDDD", linewidth=0.6)


def _name_limbs(axes: Axes, lengths: Float[np.ndarray, "C B"], distance: float) -> None:
    """Write the names of the limbs beside their lines, at least ``distance`` apart."""
    pairs = lengths.reshape(len(lengths), len(_LIMBS), 2)
    measured = [
        (float(np.nanmedian(pairs[:, limb])), name)
        for limb, name in enumerate(_LIMBS)
        if np.isfinite(pairs[:, limb]).any()
    ]
    transform = axes.get_yaxis_transform()
    lowest = 0.0
    for length, name in sorted(measured):
        at = max(length, lowest)
        lowest = at + distance
        axes.text(1.0, at, f" {name}", transform=transform, va="center", fontsize=8)
