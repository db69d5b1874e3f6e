"""Figures of a test run, drawn without pyplot: a user's own plots share nothing with them."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ghpt.models.aggregation import AGGREGATIONS
from ghpt.report.tables import PosePriors
from ghpt.skeleton import BONES, JOINT, JOINTS, PELVIS, SYMMETRIC_BONES, THORAX

LineStyle = Literal["-", "--", "-.", ":"] | tuple[int, tuple[int, ...]]

# Okabe and Ito's palette: told apart by all kinds of colour vision, and left from right by dashes
# too.
LEFT = "#0072B2"
RIGHT = "#D55E00"
MIDDLE = "#000000"
TRUTH = "#BBBBBB"
SELECTION_COLOURS = dict(
    zip(
        AGGREGATIONS,
        ("#0072B2", "#56B4E9", "#009E73", "#D55E00", "#CC79A7", "#F0E442", "#000000", "#999999"),
        strict=True,
    )
)
SELECTION_HATCHES = dict(
    zip(AGGREGATIONS, ("", "//", "...", "\\\\", "xx", "--", "", "oo"), strict=True)
)
"""The same in print without colours."""
_SIDE_COLOURS = {"left": LEFT, "right": RIGHT, "middle": MIDDLE}
_SIDE_STYLES: dict[str, LineStyle] = {"left": "-", "right": (0, (3, 1)), "middle": "-"}
_MARGIN = 80
"""mm about the poses."""


def _side(bone: tuple[int, int]) -> str:
    """Return the side of the body that a bone is on."""
    names = "".join(JOINTS[joint] for joint in bone)
    return next((side for side in ("left", "right") if side in names), "middle")


_BONES = {side: np.array([bone for bone in BONES if _side(bone) == side]) for side in _SIDE_COLOURS}
"""The bones of each side, as pairs of joints."""


def skeletons(
    truth: Float[np.ndarray, "17 3"],
    poses: Mapping[str, Float[np.ndarray, "17 3"]],
    up: Float[np.ndarray, 3],
    heading: str,
) -> Figure:
    """Draw in one row the truth, then each pose over the truth in grey, on one scale.

    World frame, mm; a joint of a pose is NaN where it is missing, the truth is whole. All are
    centred at the pelvis. The view is orthographic, from the front of the true person and turned by
    30 degrees; ``up`` points away from the ground.
    """
    view = _view(truth, up)
    drawn = {"truth": (truth - truth[PELVIS]) @ view.T}
    errors = {}
    for name, pose in poses.items():
        centre = truth[PELVIS] if np.isnan(pose[PELVIS]).any() else pose[PELVIS]
        drawn[name] = (pose - centre) @ view.T
        errors[name] = np.linalg.norm(pose - centre - truth + truth[PELVIS], axis=-1)
    every_joint = np.concatenate(list(drawn.values()))
    low = np.nanmin(every_joint, axis=0) - _MARGIN
    high = np.nanmax(every_joint, axis=0) + _MARGIN
    figure = Figure(figsize=(2.2 * len(drawn), 4.2), layout="constrained")
    panels = figure.subplots(1, len(drawn), squeeze=False)[0]
    for axes, (name, pose) in zip(panels, drawn.items(), strict=True):
        if name in errors:
            _draw_bones(axes, drawn["truth"], _BONES.values(), color=TRUTH, linewidth=4)
        _draw_pose(axes, pose)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        axes.set(xticks=[], yticks=[])
        caption = f"{name}\n{_error_text(errors[name])}" if name in errors else name
        axes.set_title(caption, fontsize=11)
        axes.spines[:].set_visible(False)
    _draw_scale(panels[0], low)
    handles = _side_handles(with_truth=bool(poses))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)
    figure.suptitle(wrap_lines(heading, 55 * len(drawn) // 2), fontsize=10)
    return figure


def _error_text(errors: Float[np.ndarray, 17]) -> str:
    return "missing" if np.isnan(errors).all() else f"{np.nanmean(errors):.1f} mm"


def _side_handles(with_truth: bool) -> list[Line2D]:
    """Return the entries of the legend."""
    handles = []
    for side, colour in _SIDE_COLOURS.items():
        style = _SIDE_STYLES[side]
        handles.append(Line2D([], [], color=colour, linestyle=style, linewidth=2, label=side))
    if with_truth:
        handles.append(Line2D([], [], color=TRUTH, linewidth=4, label="truth"))
    return handles


def pose_prior_bars(priors: PosePriors, subject: str, title: str) -> Figure:
    """Draw fig:pose-prior: S² of a subject's six parts under the eight selections, log scale."""
    figure = Figure(figsize=(9, 4), layout="constrained")
    axes = figure.subplots()
    selections = [name for name in AGGREGATIONS if name in priors]
    width = 0.84 / len(selections)
    for index, name in enumerate(selections):
        prior = priors[name]
        heights = np.array([prior[part] for part in SYMMETRIC_BONES], dtype=float)
        offset = (index - (len(selections) - 1) / 2) * width
        axes.bar(
            np.arange(len(SYMMETRIC_BONES)) + offset,
            heights,
            width,
            color=SELECTION_COLOURS[name],
            hatch=SELECTION_HATCHES[name],
            edgecolor="black",
            linewidth=0.4,
            label=name,
        )
    axes.set_yscale("log")
    axes.set_xticks(
        range(len(SYMMETRIC_BONES)), [part.replace("_", " ") for part in SYMMETRIC_BONES]
    )
    axes.set_ylabel("S²: variance of left / right length")
    heading = f"Pose prior of {subject} (lower is better)\n{title}"
    axes.set_title(wrap_lines(heading, 110), fontsize=10)
    axes.grid(axis="y", color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=8, frameon=False, fontsize=9)
    return figure


def image(figure: Figure, dpi: int = 100) -> UInt8[np.ndarray, "H W 3"]:
    """Return the figure's pixels, RGB."""
    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def up_axis(truth: Float[np.ndarray, "N 17 3"]) -> Float[np.ndarray, 3]:
    """Return the signed axis of the world along which people stand: data sets differ (z, -y)."""
    trunks = truth[:, THORAX] - truth[:, PELVIS]
    mean = np.asarray(np.nanmean(trunks, axis=0, dtype=np.float64))
    axis = int(np.abs(mean).argmax())
    return np.sign(mean[axis]) * np.eye(3)[axis]


def wrap_lines(text: str, width: int) -> str:
    """Return the text in lines of at most ``width`` letters: paths in a title may be long."""
    return "\n".join(textwrap.fill(line, width) for line in text.splitlines())


def _view(truth: Float[np.ndarray, "17 3"], up: Float[np.ndarray, 3]) -> Float[np.ndarray, "2 3"]:
    """Return two rows: where image right and image up are in the world."""
    across = truth[JOINT["left_hip"]] - truth[JOINT["right_hip"]]
    across = across - (across @ up) * up
    # Lying on the side, or with a missing hip, any direction will do.
    if not np.linalg.norm(across) > 1:
        across = np.roll(up, 1)
    across = across / np.linalg.norm(across)
    front = np.cross(across, up)
    turn = np.deg2rad(30)
    tilt = np.deg2rad(10)
    right = np.cos(turn) * across + np.sin(turn) * front
    toward = np.cross(right, up)
    return np.stack((right, np.cos(tilt) * up - np.sin(tilt) * toward))


def _draw_pose(axes: Axes, points: Float[np.ndarray, "17 2"]) -> None:
    for side, bones in _BONES.items():
        style = _SIDE_STYLES[side]
        _draw_bones(axes, points, [bones], color=_SIDE_COLOURS[side], linestyle=style, linewidth=2)
    axes.plot(points[:, 0], points[:, 1], "o", color=MIDDLE, markersize=3)


def _draw_bones(
    axes: Axes, points: Float[np.ndarray, "17 2"], bones: Iterable[np.ndarray], **style: Any
) -> None:
    """Draw the bones whose two joints are there."""
    segments = points[np.concatenate(list(bones))]
    whole = segments[~np.isnan(segments).any((1, 2))]
    axes.add_collection(LineCollection(list(whole), **style))


def _draw_scale(axes: Axes, low: Float[np.ndarray, 2]) -> None:
    """Draw a bar of 500 mm."""
    x = low[0] + 20
    y = low[1] + 30
    axes.plot([x, x + 500], [y, y], color=MIDDLE, linewidth=1.5)
    axes.text(x + 520, y, "500 mm", ha="left", va="center", fontsize=8)
