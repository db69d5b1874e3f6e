"""A rig seen from above and from the side: cameras with their uncertainty, the people, and the true
cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle

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
from ghpt.geometry.similarity import Similarity
from ghpt.report.figures import wrap_lines
from ghpt.skeleton import BONES

ESTIMATED = "#0072B2"
REFERENCE = "#D55E00"
_PEOPLE = ("#888888", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_PANELS = {"from above": (0, 1), "from the side": (0, 2)}
_NAMED = "from above"
"""Where cameras do not hide each other."""
_NAME_POINTS = 8
"""The distance of a name from its camera, points."""
_ASIDE = 0.4
"""The part of that distance from which a name is written beside its camera, not across it."""
_SKELETONS = 6
_DOTS = 300
"""Most dots that show where a person was."""
_DEVIATIONS = 2.0
"""Standard deviations that an ellipse shows."""
_MAGNIFICATIONS = (1, 10, 100)
_FRUSTUM = 0.14
"""The length of a frustum's rays, in the largest distance of a camera from the middle."""
_VISIBLE = 0.15
"""The size of an ellipse that is magnified enough, in the length of a frustum."""


@dataclass(frozen=True)
class DrawnPerson:
    """Poses of a person, mm."""

    points: Float[Tensor, "T J 3"]
    estimated: Bool[Tensor, "T J"]
    bones: Sequence[tuple[int, int]] = BONES


@dataclass(frozen=True)
class DrawnRig:
    """Cameras and the people they see, in one world; mm."""

    names: tuple[str, ...]
    cameras: Cameras
    people: tuple[DrawnPerson, ...]
    covariance: Float[Tensor, "V 6 6"] | None = None
    """Of rotation and centre; None where it is not known."""
    label: str = "cameras"
    """What the legend calls cameras without a covariance."""

    def select(self, views: Bool[Tensor, " V"]) -> DrawnRig:
        """Return the rig of some of the cameras."""
        chosen = zip(self.names, views.tolist(), strict=True)
        names = tuple(name for name, is_chosen in chosen if is_chosen)
        covariance = None if self.covariance is None else self.covariance[views]
        return DrawnRig(names, self.cameras.index(views), self.people, covariance, self.label)


def rig_figure(
    heading: str,
    rig: DrawnRig,
    upright: Similarity,
    reference: Cameras | None = None,
    reference_name: str = "",
) -> Figure:
    """Return the figure, in metres.

    ``upright`` leads from the world of the rig and of ``reference`` to one whose z is up.
    """
    figure = Figure(figsize=(11, 5.6), layout="constrained")
    cameras = upright.cameras(rig.cameras)
    other = None if reference is None else upright.cameras(reference)
    covariance = None
    if rig.covariance is not None:
        covariance = upright.R @ rig.covariance[:, 3:, 3:] @ upright.R.T / 1e6
    length = _frustum_length(cameras, other)
    magnification = 0 if covariance is None else _magnification(covariance, length)
    panels = figure.subplots(1, 2)
    for axes, (view, (i, j)) in zip(panels, _PANELS.items(), strict=True):
        plane = (i, j)
        for colour, person in zip(cycle(_PEOPLE), rig.people, strict=False):
            points = (upright.points(person.points) / 1000).numpy()
            estimated = person.estimated.numpy()
            _draw_person(axes, points[..., [i, j]], estimated, person.bones, colour)
        if other is not None:
            _draw_frustums(axes, other, length, plane, REFERENCE, "--")
        _draw_frustums(axes, cameras, length, plane, ESTIMATED, "-")
        centres = (cameras.centre / 1000).numpy()[:, [i, j]]
        if covariance is not None:
            in_plane = covariance[:, [i, j]][:, :, [i, j]].numpy()
            for centre, own in zip(centres, in_plane, strict=True):
                _draw_ellipse(axes, centre, own, magnification)
        if view == _NAMED:
            middle = centres.mean(0)
            for name, centre in zip(rig.names, centres, strict=True):
                _write_name(axes, centre, centre - middle, name)
        _lay_out(axes, view, plane)
    handles = _legend(rig, magnification, None if other is None else reference_name)
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    if heading:
        figure.suptitle(wrap_lines(heading, 110), fontsize=10, parse_math=False)
    return figure


def _frustum_length(cameras: Cameras, other: Cameras | None) -> float:
    """Return the length (metres) of the rays that are drawn of an image's corners."""
    centres = cameras.centre if other is None else torch.cat((cameras.centre, other.centre))
    centres = centres / 1000
    largest = (centres - centres.mean(0)).norm(dim=-1).max()
    return _FRUSTUM * float(largest.clamp(min=0.1))


def _magnification(covariance: Float[Tensor, "V 3 3"], length: float) -> int:
    """Return by how much the ellipses are magnified, so that the largest can be seen."""
    variance = covariance.diagonal(dim1=-2, dim2=-1).max()
    size = _DEVIATIONS * float(variance.clamp(min=0).sqrt())
    enough = (m for m in _MAGNIFICATIONS if size * m > _VISIBLE * length)
    return next(enough, _MAGNIFICATIONS[-1])


def _write_name(
    axes: Axes, centre: Float[np.ndarray, " 2"], outward: Float[np.ndarray, " 2"], name: str
) -> None:
    """Write a camera's name on its far side from the others: its frustum is on the near one."""
    distance = float(np.hypot(*outward))
    x, y = outward / distance if distance else np.ones(2)
    axes.annotate(
        name,
        (float(centre[0]), float(centre[1])),
        xytext=(_NAME_POINTS * x, _NAME_POINTS * y),
        textcoords="offset points",
        ha="left" if x > _ASIDE else "right" if x < -_ASIDE else "center",
        va="bottom" if y > _ASIDE else "top" if y < -_ASIDE else "center",
        fontsize=8,
        parse_math=False,  # a dollar in a name begins no formula
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.5},
    )


def _lay_out(axes: Axes, view: str, plane: tuple[int, int]) -> None:
    horizontal, vertical = plane
    axes.set(xlabel="xyz"[horizontal] + ", m", ylabel="xyz"[vertical] + ", m", aspect="equal")
    axes.set_title(view, fontsize=10)
    axes.grid(color="#E5E5E5", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.margins(0.15)
    axes.spines[["top", "right"]].set_visible(False)


def _legend(rig: DrawnRig, magnification: int, reference_name: str | None) -> list[Line2D]:
    times = f", {magnification} x" if magnification > 1 else ""
    label = f"calibrated; ellipse: {_DEVIATIONS:g} standard deviations{times}"
    if not magnification:
        label = rig.label
    handles = [Line2D([], [], color=ESTIMATED, label=label)]
    if reference_name is not None:
        handles.append(Line2D([], [], color=REFERENCE, linestyle="--", label=reference_name))
    several = len(rig.people) > 1
    for person, colour in zip(range(len(rig.people)), cycle(_PEOPLE), strict=False):
        label = f"person {person}" if several else "the person"
        handles.append(Line2D([], [], color=colour, marker=".", label=label))
    return handles


def _draw_frustums(
    axes: Axes, cameras: Cameras, length: float, plane: tuple[int, int], colour: str, style: str
) -> None:
    """Draw pyramids of the images (as large as twice the principal point), their tops at the
    centres.
    """
    corners = torch.tensor([[0.0, 0], [2, 0], [2, 2], [0, 2]], dtype=torch.float64)
    pixels = corners * cameras.K[:, None, :2, 2]
    homogeneous = torch.nn.functional.pad(pixels, (0, 1), value=1.0)
    rays = homogeneous @ torch.linalg.inv(cameras.K).mT
    centre = cameras.centre / 1000
    in_world = centre[:, None] + length * rays @ cameras.R
    ends = in_world.numpy()[..., list(plane)]
    tops = np.broadcast_to(centre.numpy()[:, None, list(plane)], ends.shape)
    edges = np.stack([tops, ends], -2)
    sides = np.stack([ends, np.roll(ends, 1, axis=1)], -2)
    lines = np.concatenate([edges, sides], 1).reshape(-1, 2, 2)
    axes.add_collection(
        LineCollection(list(lines), colors=colour, linestyles=style, linewidths=1.2)
    )
    axes.plot(*tops[:, 0].T, "o", color=colour, markersize=3)


def _draw_ellipse(
    axes: Axes,
    centre: Float[np.ndarray, " 2"],
    covariance: Float[np.ndarray, "2 2"],
    magnification: int,
) -> None:
    values, vectors = np.linalg.eigh(covariance)
    height, width = 2 * magnification * _DEVIATIONS * np.sqrt(values.clip(0))
    angle = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
    position = (float(centre[0]), float(centre[1]))
    ellipse = Ellipse(
        position, width, height, angle=angle, color=ESTIMATED, alpha=0.25, linewidth=0
    )
    axes.add_patch(ellipse)


def _draw_person(
    axes: Axes,
    points: Float[np.ndarray, "T J 2"],
    estimated: Bool[np.ndarray, "T J"],
    bones: Sequence[tuple[int, int]],
    colour: str,
) -> None:
    """Draw the middle of the person in every frame, and some skeletons."""
    frames = np.flatnonzero(estimated.any(1))
    if not len(frames):
        return
    dotted = frames[:: -(-len(frames) // _DOTS)]
    middle = np.stack([np.median(points[t][estimated[t]], axis=0) for t in dotted])
    axes.plot(*middle.T, ".", color=colour, markersize=1.5)
    spread = np.linspace(0, len(frames) - 1, min(_SKELETONS, len(frames)))
    for t in frames[spread.astype(int)]:
        lines = [points[t][list(bone)] for bone in bones if estimated[t][list(bone)].all()]
        axes.add_collection(LineCollection(lines, colors=colour, linewidths=0.9, alpha=0.8))
