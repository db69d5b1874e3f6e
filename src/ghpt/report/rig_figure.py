"""A rig seen from above and from the side: cameras with their uncertainty, the people, and the true
cameras.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse
from torch import Tensor

from ghpt.geometry.cameras import Cameras
from ghpt.report.figures import MIDDLE, wrapped
from ghpt.report.rig_comparison import Similarity
from ghpt.skeleton import BONES

ESTIMATED, REFERENCE, PEOPLE = "#0072B2", "#D55E00", "#999999"
_PANELS = (("from above", (0, 1)), ("from the side", (0, 2)))
_SKELETONS = 6
_DEVIATIONS = 2.0
"""Standard deviations that an ellipse shows."""


def rig_figure(
    heading: str,
    names: tuple[str, ...],
    cameras: Cameras,
    covariance: Float[Tensor, "V 6 6"],
    points: Float[Tensor, "T J 3"],
    estimated: Bool[Tensor, "T J"],
    upright: Similarity,
    reference: Cameras | None = None,
    reference_name: str = "",
) -> Figure:
    """Metres. ``cameras``, ``covariance`` (of turn and centre), ``points`` and ``reference`` are in
    one world, and ``upright`` leads to one whose z is up.
    """
    figure = Figure(figsize=(11, 5.6), layout="constrained")
    panels = figure.subplots(1, 2)
    spread = upright.R @ covariance[:, 3:, 3:] @ upright.R.T / 1e6
    shown = upright.cameras(cameras)
    other = None if reference is None else upright.cameras(reference)
    people = (upright.points(points) / 1000).numpy()
    far = torch.cat([c.centre for c in (shown, other) if c is not None]) / 1000
    length = 0.07 * float((far - far.mean(0)).norm(dim=-1).max().clamp(min=0.1)) * 2
    deviation = float(spread.diagonal(dim1=-2, dim2=-1).max().clamp(min=0).sqrt())
    magnified = next((m for m in (1, 10, 100) if _DEVIATIONS * deviation * m > 0.15 * length), 100)
    for axes, (view, (i, j)) in zip(panels, _PANELS, strict=True):
        _people(axes, people[..., [i, j]], estimated.numpy())
        if other is not None:
            _frustums(axes, other, length, (i, j), REFERENCE, "--")
        _frustums(axes, shown, length, (i, j), ESTIMATED, "-")
        centre = (shown.centre / 1000).numpy()[:, [i, j]]
        for v, name in enumerate(names):
            _ellipse(axes, centre[v], spread[v][[i, j]][:, [i, j]].numpy(), magnified)
            # a dollar in a name begins no formula
            label = {"xytext": (5, 5), "textcoords": "offset points", "fontsize": 8}
            axes.annotate(name, centre[v], parse_math=False, **label)
        axes.set(xlabel="xyz"[i] + ", m", ylabel="xyz"[j] + ", m", aspect="equal")
        axes.set_title(view, fontsize=10)
        axes.grid(color="#E5E5E5", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.margins(0.12)
        axes.spines[["top", "right"]].set_visible(False)
    times = f", {magnified} x" if magnified > 1 else ""
    handles = [
        Line2D(
            [],
            [],
            color=ESTIMATED,
            label=f"calibrated; ellipse: {_DEVIATIONS:g} standard deviations{times}",
        )
    ]
    if other is not None:
        handles.append(Line2D([], [], color=REFERENCE, linestyle="--", label=reference_name))
    handles.append(Line2D([], [], color=PEOPLE, marker=".", label="people"))
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    figure.suptitle(wrapped(heading, 110), fontsize=10, parse_math=False)
    return figure


def _frustums(
    axes: Axes, cameras: Cameras, length: float, plane: tuple[int, int], colour: str, style: str
) -> None:
    """Pyramids of the images (as large as twice the principal point), their tops at the centres."""
    corners = torch.tensor([[0.0, 0], [2, 0], [2, 2], [0, 2]], dtype=torch.float64)
    pixels = corners * cameras.K[:, None, :2, 2]
    rays = (
        torch.cat((pixels, torch.ones_like(pixels[..., :1])), -1) @ torch.linalg.inv(cameras.K).mT
    )
    centre = cameras.centre / 1000
    ends = (centre[:, None] + length * rays @ cameras.R).numpy()[..., list(plane)]
    tops = np.broadcast_to(centre.numpy()[:, None, list(plane)], ends.shape)
    segments = np.concatenate(
        [np.stack([tops, ends], -2), np.stack([ends, np.roll(ends, 1, axis=1)], -2)], 1
    )
    axes.add_collection(
        LineCollection(segments.reshape(-1, 2, 2), colors=colour, linestyles=style, linewidths=1.2)
    )
    axes.plot(*tops[:, 0].T, "o", color=colour, markersize=3)


def _ellipse(
    axes: Axes,
    centre: Float[np.ndarray, " 2"],
    covariance: Float[np.ndarray, "2 2"],
    magnified: int,
) -> None:
    values, vectors = np.linalg.eigh(covariance)
    width, height = 2 * magnified * _DEVIATIONS * np.sqrt(values.clip(0))[::-1]
    angle = np.degrees(np.arctan2(*vectors[::-1, 1]))
    axes.add_patch(
        Ellipse(tuple(centre), width, height, angle=angle, color=ESTIMATED, alpha=0.25, linewidth=0)
    )


def _people(
    axes: Axes, points: Float[np.ndarray, "T J 2"], estimated: Bool[np.ndarray, "T J"]
) -> None:
    """The middle of the person in every frame, and some skeletons."""
    frames = np.flatnonzero(estimated.any(1))
    if not len(frames):
        return
    middle = np.stack([np.median(points[t][estimated[t]], axis=0) for t in frames])
    axes.plot(*middle.T, ".", color=PEOPLE, markersize=1.5)
    for t in frames[np.linspace(0, len(frames) - 1, min(_SKELETONS, len(frames))).astype(int)]:
        segments = [points[t][list(bone)] for bone in BONES if estimated[t][list(bone)].all()]
        axes.add_collection(LineCollection(segments, colors=MIDDLE, linewidths=0.7, alpha=0.6))
