"""Figures of the camera problem: a rig with its estimated cameras, and the sweep over the number of frames."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from torch import Tensor

from ghpt.geometry.cameras import Cameras
from ghpt.recording import RelativePoseEstimate
from ghpt.report.figures import TRUTH, wrapped
from ghpt.report.pair_evaluate import camera_after
from ghpt.report.pair_tables import NAMES, NONE
from ghpt.report.tables import markdown

# Okabe and Ito's palette again; told apart in grey print by markers and dashes.
_STYLES = {
    "weight": ("#0072B2", "-", "o"), "average": ("#56B4E9", (0, (4, 1)), "v"), "eight_point": ("#D55E00", "--", "s"),
    "ransac": ("#E69F00", "-.", "D"), "usac_magsac": ("#009E73", (0, (1, 1)), "^"),
    "usac_accurate": ("#999999", (0, (5, 1, 1, 1)), "<"), "poselib": ("#CC79A7", (0, (3, 1, 1, 1, 1, 1)), "P"),
    "rig": ("#000000", (0, (6, 2)), "X"),
}  # fmt: skip
_OTHER = ("#F0E442", ":", "*")
_BANDS = ("weight", "eight_point")
"""The two of the paper's figure; the bands of others are fainter, so that many can be told apart."""
CLIP = 80.0
"""mm at which fig:comparison-to-8-point is cut."""
_MANY_CAMERAS = 8
"""With more cameras than these only the estimates from the first camera are drawn."""

Sweep = Mapping[str, Mapping[int, Sequence[float]]]
"""Method -> M -> E_3D (mm; inf where it failed) of the repeats."""


def rig_figure(
    cameras: Cameras,
    names: Sequence[str],
    points: Float[Tensor, "P 3"],
    pair: Int[Tensor, "N 2"],
    estimates: Mapping[str, RelativePoseEstimate],
    heading: str,
) -> Figure:
    """A rig from above and from the side: its true cameras, and over them the target camera of every pair, put after
    the pair's true reference camera as each of ``estimates`` (N poses, mm) has it; points X* as dots."""
    if len(names) > _MANY_CAMERAS:
        first = pair[:, 0] == pair[:, 0].min()
        pair = pair[first]
        estimates = {k: RelativePoseEstimate(e.R[first], e.t[first], e.estimated[first]) for k, e in estimates.items()}
    right, forward, up = _axes_of(cameras)
    centre = cameras.centre.numpy()
    extent = float(np.linalg.norm(np.ptp(centre, axis=0)))
    size = 0.09 * extent
    off = {name: _off(cameras, pair, estimate) for name, estimate in estimates.items()}
    times = _enlargement(np.concatenate([d for _, d in off.values()]), extent)
    figure = Figure(figsize=(10, 5.6), layout="constrained")
    panels = figure.subplots(1, 2)
    views = (np.stack((right, forward)), np.stack((right, up)))
    for axes, view, caption in zip(panels, views, ("from above", "from the side"), strict=True):
        axes.plot(*(points.numpy() @ view.T / 1000).T, ".", color="#DDDDDD", markersize=2, zorder=0)
        _draw(axes, cameras, size, view, TRUTH, "-", 4.5, 1)
        for name, estimate in estimates.items():
            colour, style, marker = _STYLES.get(name, _OTHER)
            _draw(axes, _targets(cameras, pair, estimate), size, view, colour, style, 0.9, 2)
            start, difference = (x @ view.T / 1000 for x in off[name])
            stalks = np.stack((start, start + times * difference), axis=1)
            axes.add_collection(LineCollection(stalks, colors=colour, linewidths=1.6, zorder=3))
            axes.plot(*stalks[:, 1].T, marker, color=colour, markersize=5, zorder=4)
        _limits(axes, (cameras.centre.numpy() @ view.T) / 1000, points.numpy() @ view.T / 1000, size / 1000)
        axes.set_title(caption, fontsize=10)
    if len(names) <= _MANY_CAMERAS:
        _name(panels[0], names, centre @ views[0].T / 1000, centre.mean(0) @ views[0].T / 1000, size / 1000)
    handles = [Line2D([], [], color=TRUTH, linewidth=4.5, label="true cameras")]
    for name, estimate in estimates.items():
        colour, style, marker = _STYLES.get(name, _OTHER)
        label = f"{NAMES.get(name, name)}: {_said(estimate, off[name][1])}; stalks: {times} times that"
        handles.append(
            Line2D([], [], color=colour, linestyle=style, linewidth=1.2, marker=marker, markersize=5, label=label)
        )
    figure.legend(handles=handles, loc="outside lower center", ncols=1, frameon=False, fontsize=9)
    figure.suptitle(wrapped(heading, 110), fontsize=10)
    return figure


def frames_sweep(results: Sweep, heading: str) -> Figure:
    """fig:comparison-to-8-point: mean E_3D over the repeats against M, with bands of one standard deviation, cut at
    ``CLIP`` mm."""
    figure = Figure(figsize=(6.4, 4.4), layout="constrained")
    axes = figure.subplots()
    for name, by_frames in results.items():
        colour, style, marker = _STYLES.get(name, _OTHER)
        frames = sorted(by_frames)
        mean, deviation, _ = np.array([_statistics(by_frames[m]) for m in frames]).T
        low, high = (np.clip(np.nan_to_num(mean + s * deviation, nan=np.inf, posinf=np.inf), 0, CLIP) for s in (-1, 1))
        axes.fill_between(frames, low, high, color=colour, alpha=0.2 if name in _BANDS else 0.08, linewidth=0)
        axes.plot(
            frames, np.minimum(mean, CLIP), color=colour, linestyle=style, marker=marker, markersize=5,
            markeredgecolor="white", markeredgewidth=0.6, linewidth=1.8, label=NAMES.get(name, name),
            zorder=4 if name == "weight" else 3,
        )  # fmt: skip
    ticks = sorted({m for by_frames in results.values() for m in by_frames})
    axes.set(xlabel="frames M", ylabel=f"$E_{{3D}}$, mm (cut at {CLIP:.0f})", xticks=ticks, ylim=(0, CLIP * 1.02))
    axes.grid(axis="y", color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title(wrapped(heading, 75), fontsize=10)
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def sweep_table(results: Sweep) -> str:
    """The sweep in Markdown: M x method, mean ± deviation (median) of E_3D, mm; a dash where a repeat failed."""
    rows = []
    for frames in sorted({m for by_frames in results.values() for m in by_frames}):
        cells = [_cell(by_frames.get(frames, ())) for by_frames in results.values()]
        rows.append([str(frames), *cells])
    return markdown(["M", *(NAMES.get(name, name) for name in results)], rows)


def _cell(values: Sequence[float]) -> str:
    mean, deviation, median = (NONE if not np.isfinite(x) else f"{x:.1f}" for x in _statistics(values))
    return NONE if not len(values) else f"{mean} ± {deviation} ({median})"


def _statistics(values: Sequence[float]) -> tuple[float, float, float]:
    """Mean, deviation (of a sample; NaN where there is none) and median."""
    array = np.array(values, dtype=np.float64)
    if not len(array):
        return np.nan, np.nan, np.nan
    finite = bool(np.isfinite(array).all())
    deviation = float(array.std(ddof=1)) if finite and len(array) > 1 else 0.0 if finite else np.nan
    return float(array.mean()), deviation, float(np.median(array))


def _axes_of(cameras: Cameras) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Right, forward and up in the world, unit vectors: up is what the images have above on average, right is the first
    camera's."""
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
    axes: Axes, cameras: Cameras, size: float, view: np.ndarray, colour: str, style: object, width: float, order: int
) -> None:
    """Each camera as a pyramid ``size`` (mm) deep, as wide as its image if the principal point is the middle."""
    K = cameras.K.numpy()
    corner = np.stack((K[:, 0, 2] / K[:, 0, 0], K[:, 1, 2] / K[:, 1, 1], np.ones(len(K))), axis=-1)
    signs = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]])
    corners = size * corner[:, None] * signs @ cameras.R.numpy() + cameras.centre.numpy()[:, None]
    apex = np.broadcast_to(cameras.centre.numpy()[:, None], corners.shape)
    edges = np.stack((corners, np.roll(corners, -1, axis=1)), axis=2)
    sides = np.stack((apex, corners), axis=2)
    segments = np.concatenate((edges, sides), axis=1).reshape(-1, 2, 3) @ view.T / 1000
    collection = LineCollection(segments, colors=colour, linestyles=[style], linewidths=width, zorder=order)
    axes.add_collection(collection)


def _limits(axes: Axes, centres: np.ndarray, points: np.ndarray, size: float) -> None:
    """About the true rig: an estimate that is far out is left out of the figure."""
    everything = np.concatenate((centres, points))
    low, high = everything.min(0) - 2 * size, everything.max(0) + 2 * size
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="m")
    axes.tick_params(labelsize=8)
    axes.grid(color="#EEEEEE", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _name(axes: Axes, names: Sequence[str], places: np.ndarray, middle: np.ndarray, size: float) -> None:
    for number, (name, place) in enumerate(zip(names, places, strict=True), start=1):
        away = place - middle
        away = away / max(np.linalg.norm(away), 1e-9)
        axes.text(*(place + 0.8 * size * away), f"{number}: {name}", ha="center", va="center", fontsize=8)


def _off(cameras: Cameras, pair: Int[Tensor, "N 2"], estimate: RelativePoseEstimate) -> tuple[np.ndarray, np.ndarray]:
    """True centres of the target cameras that were estimated, and what the estimated ones differ by; world, mm."""
    true = cameras.centre[pair[estimate.estimated][:, 1]]
    return true.numpy(), (_targets(cameras, pair, estimate).centre - true).numpy()


def _enlargement(differences: Float[np.ndarray, "N 3"], extent: float) -> int:
    """A round number of times by which the differences are seen in a figure of the rig."""
    largest = float(np.linalg.norm(differences, axis=-1).max(initial=0))
    return max((times for times in (1, 2, 5, 10, 20, 50, 100) if times * largest <= 0.15 * extent), default=1)


def _said(estimate: RelativePoseEstimate, differences: Float[np.ndarray, "N 3"]) -> str:
    """How far the estimated centres are from the true ones, in words."""
    total, missing = len(estimate.estimated), int((~estimate.estimated).sum())
    if missing == total:
        return "no pair was estimated"
    distance = np.linalg.norm(differences, axis=-1)
    without = f" ({missing} of {total} pairs have none)" if missing else ""
    return f"targets' centres {distance.min():.0f} to {distance.max():.0f} mm off{without}"
