"""Figures of a test run, drawn without pyplot, so that nothing is shared with a user's own plots."""

import textwrap
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ghpt.metrics.pose_prior import PARTS
from ghpt.models.aggregation import AGGREGATIONS
from ghpt.report.tables import title
from ghpt.skeleton import BONES, JOINT, JOINTS, PELVIS, THORAX

# Okabe and Ito's palette: told apart by all kinds of colour vision, and left from right by dashes
# too.
LEFT, RIGHT, MIDDLE, TRUTH = "#0072B2", "#D55E00", "#000000", "#BBBBBB"
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
_SIDES = tuple(
    "left" if "left" in a + b else "right" if "right" in a + b else "middle"
    for a, b in ((JOINTS[i], JOINTS[j]) for i, j in BONES)
)
_STYLES = {"left": (LEFT, "solid"), "right": (RIGHT, (0, (3, 1))), "middle": (MIDDLE, "solid")}


def skeletons(
    truth: Float[np.ndarray, "17 3"],
    poses: Mapping[str, Float[np.ndarray, "17 3"]],
    up: Float[np.ndarray, "3"],
    heading: str,
) -> Figure:
    """One row: the truth, then each pose over the truth in grey, all centred at the pelvis and on
    one scale.

    World frame, mm; a joint of a pose is NaN where it is missing, the truth is whole. The view is
    orthographic, from the front of the true person and turned by 30 degrees; ``up`` points away
    from the ground.
    """
    figure = Figure(figsize=(2.2 * (len(poses) + 1), 4.2), layout="constrained")
    view = _view(truth, up)
    true = truth - truth[PELVIS]
    shown = {"truth": true}
    for name, pose in poses.items():
        centre = truth[PELVIS] if np.isnan(pose[PELVIS]).any() else pose[PELVIS]
        shown[name] = pose - centre
    every_joint = np.concatenate([pose @ view.T for pose in shown.values()])
    low = np.nanmin(every_joint, axis=0) - 80
    high = np.nanmax(every_joint, axis=0) + 80
    panels = figure.subplots(1, len(shown), squeeze=False)[0]
    for axes, (name, pose) in zip(panels, shown.items(), strict=True):
        caption = ""
        if name != "truth":
            axes.add_collection(
                LineCollection(_segments(true @ view.T), colors=TRUTH, linewidths=4)
            )
            errors = np.linalg.norm(pose - true, axis=-1)
            caption = "\nmissing" if np.isnan(errors).all() else f"\n{np.nanmean(errors):.1f} mm"
        _draw(axes, pose @ view.T)
        axes.set(
            xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[]
        )
        axes.set_title(name + caption, fontsize=11)
        axes.spines[:].set_visible(False)
    _scale_bar(panels[0], low)
    handles = [
        Line2D([], [], color=c, linestyle=s, linewidth=2, label=side)
        for side, (c, s) in _STYLES.items()
    ]
    if poses:
        handles.append(Line2D([], [], color=TRUTH, linewidth=4, label="truth"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)
    figure.suptitle(wrapped(heading, 55 * len(shown) // 2), fontsize=10)
    return figure


def pose_prior_bars(metrics: Mapping[str, Any], subject: str) -> Figure:
    """The paper's fig:pose-prior: S^2 of a subject's six parts under the eight selections, on a log
    scale.
    """
    figure = Figure(figsize=(9, 4), layout="constrained")
    axes = figure.subplots()
    selections = [name for name in AGGREGATIONS if name in metrics["selections"]]
    width = 0.84 / len(selections)
    for i, name in enumerate(selections):
        prior = metrics["selections"][name]["pose_prior"][subject]
        heights = [np.nan if prior[part] is None else prior[part] for part in PARTS]
        place = np.arange(len(PARTS)) + (i - (len(selections) - 1) / 2) * width
        colour = SELECTION_COLOURS[name]
        hatch = SELECTION_HATCHES[name]
        axes.bar(
            place,
            heights,
            width,
            color=colour,
            hatch=hatch,
            edgecolor="black",
            linewidth=0.4,
            label=name,
        )
    axes.set_yscale("log")
    axes.set_xticks(range(len(PARTS)), [part.replace("_", " ") for part in PARTS])
    axes.set_ylabel("S²: variance of left / right length")
    heading = f"Pose prior of {subject} (lower is better)\n{title(metrics)}"
    axes.set_title(wrapped(heading, 110), fontsize=10)
    axes.grid(axis="y", color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=8, frameon=False, fontsize=9)
    return figure


def image(figure: Figure, dpi: int = 100) -> UInt8[np.ndarray, "H W 3"]:
    """The figure's pixels, RGB."""
    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def up_axis(truth: Float[np.ndarray, "N 17 3"]) -> Float[np.ndarray, "3"]:
    """The signed axis of the world along which the people stand: data sets differ (z up, y down)."""
    trunk = np.nanmean(truth[:, THORAX] - truth[:, PELVIS], axis=0, dtype=np.float64)
    axis = int(np.abs(trunk).argmax())
    return np.sign(trunk[axis]) * np.eye(3)[axis]


def wrapped(text: str, width: int) -> str:
    """Paths in a title may be long."""
    return "\n".join(textwrap.fill(line, width) for line in text.splitlines())


def _view(truth: Float[np.ndarray, "17 3"], up: Float[np.ndarray, "3"]) -> Float[np.ndarray, "2 3"]:
    """Rows: where image right and image up are in the world."""
    across = truth[JOINT["left_hip"]] - truth[JOINT["right_hip"]]
    across = across - (across @ up) * up
    if not np.linalg.norm(across) > 1:  # lying on the side, or a missing hip: any direction will do
        across = np.roll(up, 1)
    across = across / np.linalg.norm(across)
    front = np.cross(across, up)
    turn = np.deg2rad(30)
    tilt = np.deg2rad(10)
    right = np.cos(turn) * across + np.sin(turn) * front
    toward = np.cross(right, up)
    return np.stack((right, np.cos(tilt) * up - np.sin(tilt) * toward))


def _segments(
    points: Float[np.ndarray, "17 2"], sides: Collection[str] = tuple(_STYLES)
) -> Float[np.ndarray, "L 2 2"]:
    segments = points[
        np.array([bone for bone, side in zip(BONES, _SIDES, strict=True) if side in sides])
    ]
    return segments[~np.isnan(segments).any((1, 2))]


def _draw(axes: Axes, points: Float[np.ndarray, "17 2"]) -> None:
    for side, (colour, style) in _STYLES.items():
        axes.add_collection(
            LineCollection(
                _segments(points, [side]), colors=colour, linestyles=[style], linewidths=2
            )
        )
    axes.plot(points[:, 0], points[:, 1], "o", color=MIDDLE, markersize=3)


def _scale_bar(axes: Axes, low: Float[np.ndarray, "2"]) -> None:
    axes.plot([low[0] + 20, low[0] + 520], [low[1] + 30] * 2, color=MIDDLE, linewidth=1.5)
    axes.text(low[0] + 540, low[1] + 30, "500 mm", ha="left", va="center", fontsize=8)
