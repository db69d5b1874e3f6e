"""Covariance of a rig's extrinsics, from how it changes when stretches of the recording are left
out.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ghpt.calibration.independence import Persistence, persistence
from ghpt.calibration.normal_matrix import BEHIND, Linearised, linearise
from ghpt.calibration.observations import Correspondences
from ghpt.calibration.resection import PlacedRig
from ghpt.geometry.epipolar import cross_matrix

_LEAST_BLOCKS = 4
"""Of frames."""
_LEAST_SECTORS = 3
"""That people face; fewer show nothing of how their sides differ."""
_SECTOR_SHARE = 0.61
"""The share of the variance that blocks of 60 degrees show of errors whose correlation falls with
the turn as a Gaussian of 30 degrees does.
"""


@dataclass(frozen=True)
class Uncertainty:
    """In the gauge of the rig as a whole (free network): the similarity that the data cannot know
    (rotation, place and scale of all cameras together) is that which brings the cameras nearest to
    the true ones, radians and centres in units of the rig's size counting alike.
    """

    covariance: Float[Tensor, "V 6 6"]
    """Rotation vector about the world's axes (radians), then centre (world); 0 for a view that is
    not placed.
    """
    condition: float
    """Smallest eigenvalue of the normal matrix over the largest, gauge left out; 0 is degenerate.
    """
    inflation: float
    """The variance over what independent unit noise would give: the noise that was assumed too
    small, and errors that joints of a frame and frames of a time share.
    """
    repeatability: float
    """The share of the standard deviations that another recording like this one would show: what
    lasts as long as people face one way is the same in both.
    """
    persistence: Persistence


def gauge(R: Float[Tensor, "V 3 3"], centre: Float[Tensor, "V 3"]) -> Float[Tensor, "P 7"]:
    """The changes of the views' parameters that change no image: common rotation, translation,
    scale.
    """
    eye = torch.eye(3, dtype=centre.dtype).expand(len(centre), 3, 3)
    rotation = torch.cat((eye, -cross_matrix(centre)), dim=1)
    translation = torch.cat((torch.zeros_like(eye), eye), dim=1)
    scale = torch.cat((torch.zeros_like(centre), centre), dim=1)[..., None]
    return torch.cat((rotation, translation, scale), dim=-1).flatten(0, 1)


def uncertainty(
    observed: Correspondences,
    rig: PlacedRig,
    state: Linearised,
    blocks: int,
    sector: Int[Tensor, " R"],
) -> Uncertainty:
    """Return the covariance of a rig, whose size (root mean square distance of the centres from
    their mean) is 1; ``state``: its own; ``sector``: which way the people of each row face.

    It has the shape of the inverse normal matrix, and the size of a delete-a-block jackknife
    (Tukey; with unequal blocks): each block is left out in turn, and the rig is solved again with
    one Gauss-Newton step.

    1. Of at most ``blocks`` blocks of neighbouring frames, each as long as errors last. What blocks
       of this length do not show of errors that last longer is added by the errors' correlation.
       It counts at least as much as independent errors with the residuals' variance.
    2. Of the sectors that people face, where they are enough: a detector errs alike whenever it
       sees the same side of somebody, however much time is between. What they show beyond the
       first is added, and what sectors of this width do not show of it.
    """
    views = torch.nonzero(rig.placed)[:, 0]
    lasting = persistence(observed, rig)
    covariance = torch.zeros(len(rig.R), 6, 6, dtype=torch.float64)
    if not state.finite or len(views) < 2:
        return Uncertainty(covariance, 0.0, 1.0, 1.0, lasting)
    own = (6 * views[:, None] + torch.arange(6)).flatten()
    basis = torch.linalg.svd(gauge(rig.R[views], rig.centre[views]))[0][:, 7:]
    matrix = basis.T @ state.matrix[own][:, own] @ basis
    values, vectors = torch.linalg.eigh((matrix + matrix.T) / 2)
    values = values.clamp_min(1e-14 * values[-1].clamp_min(1e-300))
    inverse = vectors / values @ vectors.T

    def jackknife(block: Int[Tensor, " N"]) -> float:
        steps = _without_blocks(observed, rig, state, block, basis, own)
        variance = float(steps.square().sum()) * (len(steps) - 1) / len(steps)
        return variance / float(inverse.trace())

    count = int(min(max(lasting.independent, _LEAST_BLOCKS), blocks, lasting.frames))
    stretch = torch.arange(lasting.frames) * count // lasting.frames
    of_time = jackknife(stretch[observed.frame]) / lasting.share(lasting.frames / count)
    of_time = max(of_time, _residual_variance(observed, rig, state))
    inflation = of_time
    if int(sector.max()) + 1 >= _LEAST_SECTORS:
        of_sides = max(jackknife(sector[observed.row]) - of_time, 0.0)
        inflation += of_sides / _SECTOR_SHARE
    full = basis @ inverse @ basis.T * inflation / _curvature(observed, rig, state) ** 2
    covariance[views] = torch.stack(
        [full[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(len(views))]
    )
    condition = float(values[0] / values[-1])
    repeatability = (of_time / inflation) ** 0.5
    return Uncertainty(covariance, condition, inflation, repeatability, lasting)


def _without_blocks(
    observed: Correspondences,
    rig: PlacedRig,
    state: Linearised,
    block: Int[Tensor, " N"],
    basis: Float[Tensor, "Q P"],
    own: Int[Tensor, " Q"],
) -> Float[Tensor, "B P"]:
    """Return the steps of the rig, in the basis, that leaving out each block of points leads to."""
    steps = []
    for number in range(int(block.max()) + 1):
        part = linearise(observed, rig, rig.inlier & (block == number), state.scale)
        rest = basis.T @ (state.matrix - part.matrix)[own][:, own] @ basis
        score = basis.T @ part.scores.sum(0)[own]
        values, vectors = torch.linalg.eigh((rest + rest.T) / 2)
        values = values.clamp_min(1e-9 * values[-1].clamp_min(1e-300))
        steps.append(vectors @ ((vectors.T @ score) / values))
    return torch.stack(steps)


def _weights(observed: Correspondences, rig: PlacedRig, scale: float) -> tuple[Tensor, Tensor]:
    """Return the errors of the inliers, units of noise, and their weights under the loss."""
    error = observed.error(rig.R, rig.t, rig.points)[rig.inlier].clamp(max=BEHIND)
    return error, 1 / (1 + (error / scale) ** 2)


def _residual_variance(observed: Correspondences, rig: PlacedRig, state: Linearised) -> float:
    error, weight = _weights(observed, rig, state.scale)
    parameters = 3 * int(rig.inlier.any(0).sum()) + 6 * int(rig.placed.sum()) - 7
    freedom = max(2 * len(error) - parameters, 1)
    return float((weight * error).square().sum()) / freedom / float(weight.mean())


def _curvature(observed: Correspondences, rig: PlacedRig, state: Linearised) -> float:
    """Return the loss's curvature over its weight: along the error it bends more than across."""
    error, weight = _weights(observed, rig, state.scale)
    along = weight.square() * (1 - (error / state.scale) ** 2)
    return max(float(((weight + along) / 2).mean() / weight.mean()), 0.1)
