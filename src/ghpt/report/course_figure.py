"""A recording over time: errors of the views, states of the joints, lengths of the limbs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, Int8
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
_MOST_COLUMNS = 200
_USUAL = 0.95
"""Quantile of the distances of successive frames."""
_ERRORS = "Error of each view in what the others give, px"
_STATES = "State of each joint"
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


@dataclass(frozen=True)
class JointStates:
    """States of J joints in columns of frames."""

    names: tuple[str, ...]
    state: Int8[np.ndarray, "C J"]
    """Values of ``State``; below 0 where there is no frame."""


@dataclass(frozen=True)
class _Time:
    """The axis that the strips share: seconds where the frame rate is known, else frames."""

    first: float
    last: float
    """The frame after the last one."""
    rate_hz: float | None

    @property
    def unit(self) -> float:
        return self.rate_hz or 1.0

    @property
    def span(self) -> tuple[float, float]:
        return self.first / self.unit, self.last / self.unit


def course_figure(
    views: ViewCourse, course: Course, joints: tuple[str, ...], rate_hz: float | None
) -> Figure:
    """Return the figure of a prediction, over seconds where the frame rate is known."""
    heights = [_height(len(views.names)), _height(len(joints))]
    if course.length.shape[1]:
        heights.append(1.9)
    last = max(float(course.frame[-1]), float(views.frame[-1]) if len(views.frame) else 0.0) + 1
    time = _Time(float(course.frame[0]), last, rate_hz)
    figure, axes = _strips(heights, time)
    _draw_errors(axes[0], _ERRORS, views, time, _largest_error(views, time))
    title = f"{_STATES}, the worst of a column's frames"
    _draw_states(axes[1], title, JointStates(joints, course.state.numpy()), time)
    if len(axes) > 2:
        _draw_lengths(axes[2], course, time.unit)
    return figure


def check_figure(
    views: Mapping[str, ViewCourse],
    joints: tuple[str, ...],
    state: Int8[np.ndarray, "F J"],
    rate_hz: float | None,
) -> Figure:
    """Return the figure of a camera check: a strip of the views' errors for each of the named
    setups, all in the colours of the first one, and the states of the joints.

    ``state``: values of ``State`` in the frames of the views.
    """
    given = next(iter(views.values()))
    rows = [len(given.names)] * len(views) + [len(joints)]
    time = _Time(float(given.frame[0]), float(given.frame[-1]) + 1, rate_hz)
    figure, axes = _strips([_height(count) for count in rows], time)
    largest = _largest_error(given, time)
    for own, (name, course) in zip(axes[:-1], views.items(), strict=True):
        _draw_errors(own, f"{_ERRORS}: {name}", course, time, largest)
    column, count = _columns(given, time)
    worst = np.full((count, len(joints)), -1, np.int8)
    np.maximum.at(worst, column, state)
    _draw_states(axes[-1], _STATES, JointStates(joints, worst), time)
    return figure


def _strips(heights: Sequence[float], time: _Time) -> tuple[Figure, list[Axes]]:
    """Return a figure of panels of these heights (inches) above each other."""
    figure = Figure(figsize=(10.5, sum(heights) + 0.75 * len(heights)), layout="constrained")
    panels = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights, squeeze=False)
    axes = list(panels[:, 0])
    axes[-1].set_xlabel("time, s" if time.rate_hz else "frame")
    axes[-1].set_xlim(time.span)
    for each in axes:
        each.spines[["top", "right"]].set_visible(False)
        each.tick_params(labelsize=8)
    return figure, axes


def _height(rows: int) -> float:
    return min(max(_ROW * rows, 0.6), _MOST_HEIGHT)


def _draw_errors(
    axes: Axes, title: str, views: ViewCourse, time: _Time, largest: float | None
) -> None:
    """Draw a row for each view, whose colour is the error of the column's frames.

    ``largest``: the error of the darkest colour; None where none is measured.
    """
    axes.set_title(title, loc="left", fontsize=10)
    _name_rows(axes, views.names)
    if largest is None:
        axes.text(0.5, 0.5, "not measured", transform=axes.transAxes, ha="center", va="center")
        return
    shown = axes.imshow(
        _column_means(views, time).T,
        aspect="auto",
        extent=(*time.span, len(views.names) - 0.5, -0.5),
        interpolation="nearest",
        cmap="YlOrRd",
        vmin=0,
        vmax=largest,
    )
    bar = axes.figure.colorbar(shown, ax=axes, pad=0.01, fraction=0.03, extend="max")
    bar.ax.tick_params(labelsize=8)


def _largest_error(views: ViewCourse, time: _Time) -> float | None:
    """Return the error that is drawn darkest; None where none is measured."""
    columns = _column_means(views, time)
    if np.isnan(columns).all():
        return None
    usual = _DARK * float(np.nanmedian(columns))
    return max(float(np.nanquantile(columns, 0.98)), usual, 1.0)


def _columns(views: ViewCourse, time: _Time) -> tuple[Int[np.ndarray, " F"], int]:
    """Return the column of each frame, and how many columns there are: so few that the usual
    distance of two frames leaves none empty.
    """
    frames = len(views.frame)
    usual = float(np.quantile(np.diff(views.frame), _USUAL)) if frames > 1 else 1.0
    count = min(_MOST_COLUMNS, frames, int((time.last - time.first) / usual))
    count = max(1, count)
    share = (views.frame - time.first) / (time.last - time.first)
    return (share * count).astype(int).clip(0, count - 1), count


def _column_means(views: ViewCourse, time: _Time) -> Float[np.ndarray, "C V"]:
    """Return the mean error in columns of the time; NaN where no frame was measured."""
    column, count = _columns(views, time)
    total = np.zeros((count, len(views.names)))
    measured = np.zeros_like(total)
    np.add.at(total, column, np.nan_to_num(views.error))
    np.add.at(measured, column, np.isfinite(views.error))
    return np.where(measured > 0, total / np.maximum(measured, 1), np.nan)


def _draw_states(axes: Axes, title: str, joints: JointStates, time: _Time) -> None:
    axes.set_title(title, loc="left", fontsize=10)
    _name_rows(axes, tuple(joint.replace("_", " ") for joint in joints.names))
    colours = ListedColormap([_STATE_COLOURS[state] for state in FILE_STATES])
    axes.imshow(
        np.ma.masked_less(joints.state, 0).T,
        aspect="auto",
        extent=(*time.span, len(joints.names) - 0.5, -0.5),
        interpolation="nearest",
        cmap=colours,
        vmin=-0.5,
        vmax=len(FILE_STATES) - 0.5,
    )
    present = set(np.unique(joints.state).tolist())
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
