"""The figure of the camera problem: a rig with its true and its estimated cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from torch import Tensor

from ghpt.geometry.cameras import Cameras
from ghpt.models.relative_pose.evaluation import camera_after
from ghpt.observations import RelativePoseEstimate
from ghpt.report.figures import TRUTH, LineStyle, wrap_lines
from ghpt.report.pair_tables import NAMES


@dataclass(frozen=True)
class MethodStyle:
    """How a method is drawn; told apart in grey print by markers and dashes."""

    colour: str
    line: LineStyle
    marker: str


# Okabe and Ito's palette again.
METHOD_STYLES = {
    "weight": MethodStyle("#0072B2", "-", "o"),
    "average": MethodStyle("#56B4E9", (0, (4, 1)), "v"),
    "eight_point": MethodStyle("#D55E00", "--", "s"),
    "ransac": MethodStyle("#E69F00", "-.", "D"),
    "usac_magsac": MethodStyle("#009E73", (0, (1, 1)), "^"),
    "usac_accurate": MethodStyle("#999999", (0, (5, 1, 1, 1)), "<"),
    "poselib": MethodStyle("#CC79A7", (0, (3, 1, 1, 1, 1, 1)), "P"),
    "five_point": MethodStyle("#332288", (0, (2, 2)), "p"),
    "rig": MethodStyle("#000000", (0, (6, 2)), "X"),
}
OTHER_STYLE = MethodStyle("#F0E442", ":", "*")
_MANY_CAMERAS = 8
"""With more cameras than these only the estimates from the first camera are drawn."""
_ENLARGEMENTS = (1, 2, 5, 10, 20, 50, 100)


@dataclass(frozen=True)
class Offsets:
    """How far the estimated target cameras of a method are off, world, mm."""

    start: Float[np.ndarray, "N 3"]
    """The true centres."""
    difference: Float[np.ndarray, "N 3"]
    """From the true centres to the estimated ones."""
    pairs: int
    """All pairs, those without an estimate too."""

    @property
    def text(self) -> str:
        """The distances in words."""
        missing = self.pairs - len(self.start)
        if missing == self.pairs:
            return "no pair was estimated"
        distance = np.linalg.norm(self.difference, axis=-1)
        without = f" ({missing} of {self.pairs} pairs have none)" if missing else ""
        return f"targets' centres {distance.min():.0f} to {distance.max():.0f} mm off{without}"


def rig_figure(
    cameras: Cameras,
    names: Sequence[str],
    points: Float[Tensor, "P 3"],
    pair: Int[Tensor, "N 2"],
    estimates: Mapping[str, RelativePoseEstimate],
    heading: str,
) -> Figure:
    """Draw a rig from above and from the side: true cameras, and over them the estimated ones.

    Estimated is the target camera of every pair, put after the pair's true reference camera as each
    of ``estimates`` (N poses, mm) has it. Points X* are dots.
    """
    if len(names) > _MANY_CAMERAS:
        first = pair[:, 0] == pair[:, 0].min()
        pair = pair[first]
        estimates = {name: _select(estimate, first) for name, estimate in estimates.items()}
    right, forward, up = _axes_of(cameras)
    centres = cameras.centre.numpy()
    extent = float(np.linalg.norm(np.ptp(centres, axis=0)))
    size = 0.09 * extent * min(1.0, (_MANY_CAMERAS / len(names)) ** 0.5)
    targets = {name: _targets(cameras, pair, estimate) for name, estimate in estimates.items()}
    offsets = {name: _offsets(cameras, pair, estimates[name], targets[name]) for name in estimates}
    enlargement = _enlargement(list(offsets.values()), extent)
    figure = Figure(figsize=(10, 5.6), layout="constrained")
    panels = figure.subplots(1, 2)
    views = {"from above": np.stack((right, forward)), "from the side": np.stack((right, up))}
    for axes, (caption, view) in zip(panels, views.items(), strict=True):
        dots = points.numpy() @ view.T / 1000
        axes.plot(*dots.T, ".", color="#DDDDDD", markersize=2, zorder=0)
        _draw_cameras(axes, cameras, size, view, _TRUE_CAMERAS)
        for name in estimates:
            style = METHOD_STYLES.get(name, OTHER_STYLE)
            _draw_cameras(axes, targets[name], size, view, Pen(style.colour, style.line, 0.9, 2))
            _draw_offsets(axes, offsets[name], enlargement, view, style)
        _set_limits(axes, centres @ view.T / 1000, dots, size / 1000)
        axes.set_title(caption, fontsize=10)
    if len(names) <= _MANY_CAMERAS:
        _draw_names(panels[0], names, centres @ views["from above"].T / 1000, size / 1000)
    handles = [Line2D([], [], color=TRUTH, linewidth=4.5, label="true cameras")]
    handles += [_handle(name, own, enlargement) for name, own in offsets.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=1, frameon=False, fontsize=9)
    figure.suptitle(wrap_lines(heading, 110), fontsize=10)
    return figure


def _select(estimate: RelativePoseEstimate, rows: Bool[Tensor, " N"]) -> RelativePoseEstimate:
    return RelativePoseEstimate(estimate.R[rows], estimate.t[rows], estimate.estimated[rows])


def _handle(name: str, offsets: Offsets, enlargement: int) -> Line2D:
    """Return a method's entry of the legend."""
    style = METHOD_STYLES.get(name, OTHER_STYLE)
    return Line2D(
        [],
        [],
        color=style.colour,
        linestyle=style.line,
        linewidth=1.2,
        marker=style.marker,
        markersize=5,
        label=f"{NAMES.get(name, name)}: {offsets.text}; stalks: {enlargement} times that",
    )


def _draw_offsets(
    axes: Axes, offsets: Offsets, enlargement: int, view: np.ndarray, style: MethodStyle
) -> None:
    """Draw a stalk from each true centre towards the estimated one."""
    start = offsets.start @ view.T / 1000
    end = start + enlargement * offsets.difference @ view.T / 1000
    stalks = list(np.stack((start, end), axis=1))
    axes.add_collection(LineCollection(stalks, colors=style.colour, linewidths=1.6, zorder=3))
    axes.plot(*end.T, style.marker, color=style.colour, markersize=5, zorder=4)


def _axes_of(cameras: Cameras) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return right, forward and up in the world, unit vectors.

    Up is what the images have above on average, right is the first camera's.
    """
    up = -cameras.R[:, 1].mean(dim=0).numpy()
    if not np.linalg.norm(up) > 0.1:  # cameras turned all ways
        up = -cameras.R[0, 1].numpy()
    up = up / np.linalg.norm(up)
    x = cameras.R[0, 0].numpy()
    right = x - (x @ up) * up
    if not np.linalg.norm(right) > 1e-3:  # the first camera on its side
        right = np.cross(up, cameras.R[0, 2].numpy())
    right = right / np.linalg.norm(right)
    return right, np.cross(up, right), up


def _targets(cameras: Cameras, pair: Int[Tensor, "N 2"], estimate: RelativePoseEstimate) -> Cameras:
    """Return the estimated target cameras, of the pairs that were estimated."""
    estimated = estimate.estimated
    reference, target = pair[estimated].unbind(1)
    R, t = camera_after(cameras.index(reference), estimate.R[estimated], estimate.t[estimated])
    return Cameras(cameras.K[target], R, t)


def _offsets(
    cameras: Cameras,
    pair: Int[Tensor, "N 2"],
    estimate: RelativePoseEstimate,
    targets: Cameras,
) -> Offsets:
    true = cameras.centre[pair[estimate.estimated][:, 1]]
    return Offsets(true.numpy(), (targets.centre - true).numpy(), len(pair))


@dataclass(frozen=True)
class Pen:
    """How cameras are drawn."""

    colour: str
    line: LineStyle
    width: float
    order: int


_TRUE_CAMERAS = Pen(TRUTH, "-", 4.5, 1)


def _draw_cameras(axes: Axes, cameras: Cameras, size: float, view: np.ndarray, pen: Pen) -> None:
    """Draw each camera as a pyramid ``size`` (mm) deep.

    It is as wide as the image if the principal point is the middle.
    """
    K = cameras.K.numpy()
    slope_x = K[:, 0, 2] / K[:, 0, 0]
    slope_y = K[:, 1, 2] / K[:, 1, 1]
    corner = np.stack((slope_x, slope_y, np.ones(len(K))), axis=-1)
    signs = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]])
    centres = cameras.centre.numpy()[:, None]
    corners = size * corner[:, None] * signs @ cameras.R.numpy() + centres
    apex = np.broadcast_to(centres, corners.shape)
    edges = np.stack((corners, np.roll(corners, -1, axis=1)), axis=2)
    sides = np.stack((apex, corners), axis=2)
    segments = np.concatenate((edges, sides), axis=1).reshape(-1, 2, 3) @ view.T / 1000
    collection = LineCollection(
        list(segments),
        colors=pen.colour,
        linestyles=[pen.line],
        linewidths=pen.width,
        zorder=pen.order,
    )
    axes.add_collection(collection)


def _set_limits(axes: Axes, centres: np.ndarray, points: np.ndarray, size: float) -> None:
    """Show the true rig: an estimate that is far out is left out of the figure."""
    everything = np.concatenate((centres, points))
    low = everything.min(0) - 2 * size
    high = everything.max(0) + 2 * size
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="m")
    axes.tick_params(labelsize=8)
    axes.grid(color="#EEEEEE", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _draw_names(axes: Axes, names: Sequence[str], centres: np.ndarray, size: float) -> None:
    """Draw the cameras' numbers and names outside the rig."""
    middle = centres.mean(0)
    for number, (name, centre) in enumerate(zip(names, centres, strict=True), start=1):
        direction = centre - middle
        direction = direction / max(np.linalg.norm(direction), 1e-9)
        x, y = centre + 0.8 * size * direction
        axes.text(x, y, f"{number}: {name}", ha="center", va="center", fontsize=8)


def _enlargement(offsets: Sequence[Offsets], extent: float) -> int:
    """Return a round number of times by which the differences are seen in a figure of the rig."""
    differences = np.concatenate([own.difference for own in offsets])
    largest = float(np.linalg.norm(differences, axis=-1).max(initial=0))
    fitting = [times for times in _ENLARGEMENTS if times * largest <= 0.15 * extent]
    return max(fitting, default=1)
