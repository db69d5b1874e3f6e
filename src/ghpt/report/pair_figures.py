"""The figure of the camera problem: a rig with its true and its estimated cameras."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from torch import Tensor

from ghpt.geometry.cameras import Cameras
from ghpt.models.relative_pose.evaluation import camera_after
from ghpt.observations import RelativePoseEstimate
from ghpt.report.figures import TRUTH, wrapped
from ghpt.report.pair_tables import NAMES

# Okabe and Ito's palette again; told apart in grey print by markers and dashes.
METHOD_STYLES = {
    "weight": ("#0072B2", "-", "o"),
    "average": ("#56B4E9", (0, (4, 1)), "v"),
    "eight_point": ("#D55E00", "--", "s"),
    "ransac": ("#E69F00", "-.", "D"),
    "usac_magsac": ("#009E73", (0, (1, 1)), "^"),
    "usac_accurate": ("#999999", (0, (5, 1, 1, 1)), "<"),
    "poselib": ("#CC79A7", (0, (3, 1, 1, 1, 1, 1)), "P"),
    "rig": ("#000000", (0, (6, 2)), "X"),
}
OTHER_STYLE = ("#F0E442", ":", "*")
_MANY_CAMERAS = 8
"""With more cameras than these only the estimates from the first camera are drawn."""


def rig_figure(
    cameras: Cameras,
    names: Sequence[str],
    points: Float[Tensor, "P 3"],
    pair: Int[Tensor, "N 2"],
    estimates: Mapping[str, RelativePoseEstimate],
    heading: str,
) -> Figure:
    """A rig from above and from the side: its true cameras, and over them the target camera of
    every pair, put after the pair's true reference camera as each of ``estimates`` (N poses, mm)
    has it; points X* as dots.
    """
    if len(names) > _MANY_CAMERAS:
        first = pair[:, 0] == pair[:, 0].min()
        pair = pair[first]
        estimates = {
            k: RelativePoseEstimate(e.R[first], e.t[first], e.estimated[first])
            for k, e in estimates.items()
        }
    right, forward, up = _axes_of(cameras)
    centre = cameras.centre.numpy()
    extent = float(np.linalg.norm(np.ptp(centre, axis=0)))
    size = 0.09 * extent * min(1.0, (_MANY_CAMERAS / len(names)) ** 0.5)
    off = {name: _off(cameras, pair, estimate) for name, estimate in estimates.items()}
    times = _enlargement(np.concatenate([d for _, d in off.values()]), extent)
    figure = Figure(figsize=(10, 5.6), layout="constrained")
    panels = figure.subplots(1, 2)
    views = (np.stack((right, forward)), np.stack((right, up)))
    for axes, view, caption in zip(panels, views, ("from above", "from the side"), strict=True):
        axes.plot(*(points.numpy() @ view.T / 1000).T, ".", color="#DDDDDD", markersize=2, zorder=0)
        _draw(axes, cameras, size, view, TRUTH, "-", 4.5, 1)
        for name, estimate in estimates.items():
            colour, style, marker = METHOD_STYLES.get(name, OTHER_STYLE)
            _draw(axes, _targets(cameras, pair, estimate), size, view, colour, style, 0.9, 2)
            start, difference = (x @ view.T / 1000 for x in off[name])
            stalks = np.stack((start, start + times * difference), axis=1)
            axes.add_collection(LineCollection(stalks, colors=colour, linewidths=1.6, zorder=3))
            axes.plot(*stalks[:, 1].T, marker, color=colour, markersize=5, zorder=4)
        _limits(
            axes,
            (cameras.centre.numpy() @ view.T) / 1000,
            points.numpy() @ view.T / 1000,
            size / 1000,
        )
        axes.set_title(caption, fontsize=10)
    if len(names) <= _MANY_CAMERAS:
        _name(
            panels[0],
            names,
            centre @ views[0].T / 1000,
            centre.mean(0) @ views[0].T / 1000,
            size / 1000,
        )
    handles = [Line2D([], [], color=TRUTH, linewidth=4.5, label="true cameras")]
    for name, estimate in estimates.items():
        colour, style, marker = METHOD_STYLES.get(name, OTHER_STYLE)
        label = (
            f"{NAMES.get(name, name)}: {_said(estimate, off[name][1])}; stalks: {times} times that"
        )
        handles.append(
            Line2D(
                [],
                [],
                color=colour,
                linestyle=style,
                linewidth=1.2,
                marker=marker,
                markersize=5,
                label=label,
            )
        )
    figure.legend(handles=handles, loc="outside lower center", ncols=1, frameon=False, fontsize=9)
    figure.suptitle(wrapped(heading, 110), fontsize=10)
    return figure


def _axes_of(cameras: Cameras) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Right, forward and up in the world, unit vectors: up is what the images have above on
    average, right is the first camera's.
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
    """The estimated target cameras, of the pairs that were estimated."""
    pair, R, t = (x[estimate.estimated] for x in (pair, estimate.R, estimate.t))
    return Cameras(cameras.K[pair[:, 1]], *camera_after(cameras.index(pair[:, 0]), R, t))


def _draw(
    axes: Axes,
    cameras: Cameras,
    size: float,
    view: np.ndarray,
    colour: str,
    style: object,
    width: float,
    order: int,
) -> None:
    """Each camera as a pyramid ``size`` (mm) deep, as wide as its image if the principal point is
    the middle.
    """
    K = cameras.K.numpy()
    corner = np.stack((K[:, 0, 2] / K[:, 0, 0], K[:, 1, 2] / K[:, 1, 1], np.ones(len(K))), axis=-1)
    signs = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]])
    corners = size * corner[:, None] * signs @ cameras.R.numpy() + cameras.centre.numpy()[:, None]
    apex = np.broadcast_to(cameras.centre.numpy()[:, None], corners.shape)
    edges = np.stack((corners, np.roll(corners, -1, axis=1)), axis=2)
    sides = np.stack((apex, corners), axis=2)
    segments = np.concatenate((edges, sides), axis=1).reshape(-1, 2, 3) @ view.T / 1000
    collection = LineCollection(
        segments, colors=colour, linestyles=[style], linewidths=width, zorder=order
    )
    axes.add_collection(collection)


def _limits(axes: Axes, centres: np.ndarray, points: np.ndarray, size: float) -> None:
    """About the true rig: an estimate that is far out is left out of the figure."""
    everything = np.concatenate((centres, points))
    low = everything.min(0) - 2 * size
    high = everything.max(0) + 2 * size
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="m")
    axes.tick_params(labelsize=8)
    axes.grid(color="#EEEEEE", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _name(
    axes: Axes, names: Sequence[str], places: np.ndarray, middle: np.ndarray, size: float
) -> None:
    for number, (name, place) in enumerate(zip(names, places, strict=True), start=1):
        away = place - middle
        away = away / max(np.linalg.norm(away), 1e-9)
        axes.text(
            *(place + 0.8 * size * away), f"{number}: {name}", ha="center", va="center", fontsize=8
        )


def _off(
    cameras: Cameras, pair: Int[Tensor, "N 2"], estimate: RelativePoseEstimate
) -> tuple[np.ndarray, np.ndarray]:
    """True centres of the target cameras that were estimated, and what the estimated ones differ
    by; world, mm.
    """
    true = cameras.centre[pair[estimate.estimated][:, 1]]
    return true.numpy(), (_targets(cameras, pair, estimate).centre - true).numpy()


def _enlargement(differences: Float[np.ndarray, "N 3"], extent: float) -> int:
    """A round number of times by which the differences are seen in a figure of the rig."""
    largest = float(np.linalg.norm(differences, axis=-1).max(initial=0))
    return max(
        (times for times in (1, 2, 5, 10, 20, 50, 100) if times * largest <= 0.15 * extent),
        default=1,
    )


def _said(estimate: RelativePoseEstimate, differences: Float[np.ndarray, "N 3"]) -> str:
    """How far the estimated centres are from the true ones, in words."""
    total = len(estimate.estimated)
    missing = int((~estimate.estimated).sum())
    if missing == total:
        return "no pair was estimated"
    distance = np.linalg.norm(differences, axis=-1)
    without = f" ({missing} of {total} pairs have none)" if missing else ""
    return f"targets' centres {distance.min():.0f} to {distance.max():.0f} mm off{without}"
