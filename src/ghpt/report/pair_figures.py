"""The figure of the camera problem: a rig with its true and its estimated cameras."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.typing import LineStyleType
from torch import Tensor

from ghpt.geometry.cameras import Cameras
from ghpt.models.relative_pose.evaluation import camera_after
from ghpt.observations import RelativePoseEstimate
from ghpt.report.figures import TRUTH, wrapped
from ghpt.report.pair_tables import NAMES


@dataclass(frozen=True)
class Style:
    """How the cameras of an estimator are drawn."""

    colour: str
    dashes: LineStyleType
    marker: str


# Okabe and Ito's palette again; told apart in grey print by markers and dashes.
METHOD_STYLES = {
    "weight": Style("#0072B2", "-", "o"),
    "average": Style("#56B4E9", (0, (4, 1)), "v"),
    "eight_point": Style("#D55E00", "--", "s"),
    "ransac": Style("#E69F00", "-.", "D"),
    "usac_magsac": Style("#009E73", (0, (1, 1)), "^"),
    "usac_accurate": Style("#999999", (0, (5, 1, 1, 1)), "<"),
    "poselib": Style("#CC79A7", (0, (3, 1, 1, 1, 1, 1)), "P"),
    "rig": Style("#000000", (0, (6, 2)), "X"),
}
OTHER_STYLE = Style("#F0E442", ":", "*")
_TRUE_STYLE = Style(TRUTH, "-", "")
_MANY_CAMERAS = 8
"""With more cameras than these only the estimates from the first camera are drawn."""


@dataclass(frozen=True)
class _Offsets:
    """Where the target cameras of an estimator are; world, mm."""

    targets: Cameras
    """The estimated target cameras, of the pairs that were estimated."""
    true: Float[np.ndarray, "N 3"]
    """The true centres of these."""
    difference: Float[np.ndarray, "N 3"]
    """Estimated minus true centres."""
    summary: str
    """How far the centres are off, in words."""


def rig_figure(
    cameras: Cameras,
    names: Sequence[str],
    points: Float[Tensor, "P 3"],
    pair: Int[Tensor, "N 2"],
    estimates: Mapping[str, RelativePoseEstimate],
    heading: str,
) -> Figure:
    """Return a figure of a rig from above and from the side.

    It shows the true cameras, and over them the target camera of every pair, put after the pair's
    true reference camera as each of ``estimates`` (N poses, mm) has it; the points X* are dots.
    """
    if len(names) > _MANY_CAMERAS:
        first = pair[:, 0] == pair[:, 0].min()
        pair = pair[first]
        estimates = {name: estimate.rows(first) for name, estimate in estimates.items()}
    right, forward, up = _axes_of(cameras)
    centre = cameras.centre.numpy()
    extent = float(np.linalg.norm(np.ptp(centre, axis=0)))
    size = 0.09 * extent * min(1.0, (_MANY_CAMERAS / len(names)) ** 0.5)
    offsets = {name: _offsets(cameras, pair, estimate) for name, estimate in estimates.items()}
    times = _enlargement(np.concatenate([each.difference for each in offsets.values()]), extent)
    figure = Figure(figsize=(10, 5.6), layout="constrained")
    panels = figure.subplots(1, 2)
    views = (np.stack((right, forward)), np.stack((right, up)))
    for axes, view, caption in zip(panels, views, ("from above", "from the side"), strict=True):
        _draw_panel(axes, view, cameras, points.numpy(), offsets, times, size)
        axes.set_title(caption, fontsize=10)
    if len(names) <= _MANY_CAMERAS:
        from_above = centre @ views[0].T / 1000
        _write_names(panels[0], names, from_above, size / 1000)
    handles = [Line2D([], [], color=TRUTH, linewidth=4.5, label="true cameras")]
    for name, each in offsets.items():
        label = f"{NAMES.get(name, name)}: {each.summary}; stalks: {times} times that"
        handles.append(_handle(METHOD_STYLES.get(name, OTHER_STYLE), label))
    figure.legend(handles=handles, loc="outside lower center", ncols=1, frameon=False, fontsize=9)
    figure.suptitle(wrapped(heading, 110), fontsize=10)
    return figure


def _draw_panel(
    axes: Axes,
    view: Float[np.ndarray, "2 3"],
    cameras: Cameras,
    points: Float[np.ndarray, "P 3"],
    offsets: Mapping[str, _Offsets],
    times: int,
    size: float,
) -> None:
    """Draw the points, the true cameras and the estimated ones, seen along one direction."""
    dots = points @ view.T / 1000
    axes.plot(dots[:, 0], dots[:, 1], ".", color="#DDDDDD", markersize=2, zorder=0)
    _draw(axes, cameras, size, view, _TRUE_STYLE, width=4.5, order=1)
    for name, each in offsets.items():
        style = METHOD_STYLES.get(name, OTHER_STYLE)
        _draw(axes, each.targets, size, view, style, width=0.9, order=2)
        start = each.true @ view.T / 1000
        end = start + times * (each.difference @ view.T / 1000)
        stalks = np.stack((start, end), axis=1)
        lines = LineCollection(list(stalks), colors=style.colour, linewidths=1.6, zorder=3)
        axes.add_collection(lines)
        x, y = end.T
        axes.plot(x, y, style.marker, color=style.colour, markersize=5, zorder=4)
    centres = cameras.centre.numpy() @ view.T / 1000
    _set_limits(axes, np.concatenate((centres, dots)), size / 1000)


def _handle(style: Style, label: str) -> Line2D:
    """Return the entry of an estimator in the legend."""
    return Line2D(
        [],
        [],
        color=style.colour,
        linestyle=style.dashes,
        linewidth=1.2,
        marker=style.marker,
        markersize=5,
        label=label,
    )


def _axes_of(cameras: Cameras) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return right, forward and up in the world, unit vectors.

    Up is what the images have above on average, right is the first camera's.
    """
    up = -cameras.R[:, 1].mean(dim=0).numpy()
    x = cameras.R[0, 0].numpy()
    if not np.linalg.norm(up) > 0.1:  # cameras turned all ways
        up = -cameras.R[0, 1].numpy()
    up = up / np.linalg.norm(up)
    right = x - (x @ up) * up
    if not np.linalg.norm(right) > 1e-3:  # the first camera on its side
        right = np.cross(up, cameras.R[0, 2].numpy())
    right = right / np.linalg.norm(right)
    return right, np.cross(up, right), up


def _targets(cameras: Cameras, pair: Int[Tensor, "N 2"], estimate: RelativePoseEstimate) -> Cameras:
    """Return the estimated target cameras, of the pairs that were estimated."""
    found = estimate.estimated
    reference = cameras.index(pair[found, 0])
    R, t = camera_after(reference, estimate.R[found], estimate.t[found])
    return Cameras(cameras.K[pair[found, 1]], R, t)


def _offsets(
    cameras: Cameras, pair: Int[Tensor, "N 2"], estimate: RelativePoseEstimate
) -> _Offsets:
    targets = _targets(cameras, pair, estimate)
    true = cameras.centre[pair[estimate.estimated][:, 1]]
    difference = (targets.centre - true).numpy()
    return _Offsets(targets, true.numpy(), difference, _summarize(estimate, difference))


def _draw(
    axes: Axes,
    cameras: Cameras,
    size: float,
    view: Float[np.ndarray, "2 3"],
    style: Style,
    width: float,
    order: int,
) -> None:
    """Draw each camera as a pyramid ``size`` (mm) deep.

    It is as wide as the camera's image if the principal point is the middle.
    """
    K = cameras.K.numpy()
    x = K[:, 0, 2] / K[:, 0, 0]
    y = K[:, 1, 2] / K[:, 1, 1]
    corner = np.stack((x, y, np.ones(len(K))), axis=-1)
    signs = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]])
    apex = cameras.centre.numpy()[:, None]
    corners = size * corner[:, None] * signs @ cameras.R.numpy() + apex
    edges = np.stack((corners, np.roll(corners, -1, axis=1)), axis=2)
    sides = np.stack((np.broadcast_to(apex, corners.shape), corners), axis=2)
    segments = np.concatenate((edges, sides), axis=1).reshape(-1, 2, 3) @ view.T / 1000
    collection = LineCollection(
        list(segments),
        colors=style.colour,
        linestyles=[style.dashes],
        linewidths=width,
        zorder=order,
    )
    axes.add_collection(collection)


def _set_limits(axes: Axes, places: Float[np.ndarray, "N 2"], size: float) -> None:
    """Set the limits about the true rig: an estimate that is far out is not in the figure."""
    low = places.min(0) - 2 * size
    high = places.max(0) + 2 * size
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="m")
    axes.tick_params(labelsize=8)
    axes.grid(color="#EEEEEE", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _write_names(
    axes: Axes, names: Sequence[str], places: Float[np.ndarray, "V 2"], size: float
) -> None:
    """Write the cameras' numbers and names, away from the middle of the rig."""
    middle = places.mean(0)
    for number, (name, place) in enumerate(zip(names, places, strict=True), start=1):
        away = place - middle
        x, y = place + 0.8 * size * away / max(np.linalg.norm(away), 1e-9)
        axes.text(x, y, f"{number}: {name}", ha="center", va="center", fontsize=8)


def _enlargement(differences: Float[np.ndarray, "N 3"], extent: float) -> int:
    """Return a round number of times by which the differences are seen in a figure of the rig."""
    largest = float(np.linalg.norm(differences, axis=-1).max(initial=0))
    possible = [times for times in (1, 2, 5, 10, 20, 50, 100) if times * largest <= 0.15 * extent]
    return max(possible, default=1)


def _summarize(estimate: RelativePoseEstimate, differences: Float[np.ndarray, "N 3"]) -> str:
    """Say how far the estimated centres are from the true ones."""
    total = len(estimate.estimated)
    missing = int((~estimate.estimated).sum())
    if missing == total:
        return "no pair was estimated"
    distance = np.linalg.norm(differences, axis=-1)
    without = f" ({missing} of {total} pairs have none)" if missing else ""
    return f"targets' centres {distance.min():.0f} to {distance.max():.0f} mm off{without}"
