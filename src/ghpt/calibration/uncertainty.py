"""Covariance of a rig's extrinsics: its normal matrix and the scatter of the frames' gradients."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ghpt.calibration.normal_matrix import BEHIND, Linearised
from ghpt.calibration.observations import Correspondences
from ghpt.calibration.resection import PlacedRig
from ghpt.geometry.epipolar import cross_matrix


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
    """Variance of the frames' gradients over what independent unit noise would give: the noise that
    was assumed too small, and errors that joints of a frame and frames of a time share.
    """


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
    observed: Correspondences, rig: PlacedRig, state: Linearised, blocks: int
) -> Uncertainty:
    """``state``: of the rig, whose size (root mean square distance of the centres from their mean)
    is 1.

    The frames are put into ``blocks`` blocks of neighbours: gradients are summed within a block, so
    that errors which last as long as a block count as what they are.
    """
    views = torch.nonzero(rig.placed)[:, 0]
    covariance = torch.zeros(len(rig.R), 6, 6, dtype=torch.float64)
    if not state.finite or len(views) < 2:
        return Uncertainty(covariance, 0.0, 1.0)
    own = (6 * views[:, None] + torch.arange(6)).flatten()
    centre = rig.centre[views]
    basis = torch.linalg.svd(gauge(rig.R[views], centre))[0][:, 7:]
    matrix = basis.T @ state.matrix[own][:, own] @ basis
    values, vectors = torch.linalg.eigh((matrix + matrix.T) / 2)
    values = values.clamp_min(1e-14 * values[-1].clamp_min(1e-300))
    inverse = vectors / values @ vectors.T

    frames = len(state.scores)
    count = min(blocks, frames)
    block = torch.arange(frames) * count // frames
    scores = (
        torch.zeros(count, len(own), dtype=torch.float64).index_add(0, block, state.scores[:, own])
        @ basis
    )
    scores = scores - scores.mean(0)
    scatter = float((scores @ inverse * scores).sum()) / len(values) * count / max(count - 1, 1)
    error = observed.error(rig.R, rig.t, rig.points)[rig.inlier].clamp(max=BEHIND)
    weight = 1 / (1 + (error / state.scale) ** 2)
    freedom = 2 * len(error) - 3 * int(rig.inlier.any(0).sum()) - len(values)
    model = float((weight * error).square().sum()) / max(freedom, 1) / float(weight.mean())
    inflation = max(scatter, model)
    # the loss's curvature over its weight: along the error it bends more than across
    curvature = float(
        ((weight + weight.square() * (1 - (error / state.scale) ** 2)) / 2).mean() / weight.mean()
    )
    full = basis @ inverse @ basis.T * inflation / max(curvature, 0.1) ** 2
    covariance[views] = torch.stack(
        [full[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(len(views))]
    )
    return Uncertainty(covariance, float(values[0] / values[-1]), inflation)
