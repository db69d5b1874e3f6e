"""Other people's triangulation, as rows beside ours on the same key points."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.errors import check_positive
from ghpt.extras import check_installed
from ghpt.geometry.masking import where
from ghpt.geometry.state import State
from ghpt.geometry.triangulation import Triangulation, triangulate
from ghpt.models.estimators.classical import Estimator
from ghpt.observations import Observations

_MOST_ROWS = 2**20
"""Equations of points and subsets that are solved at once."""


@dataclass(frozen=True)
class Pose2Sim(Estimator):
    """Pose2Sim's triangulation, written anew from its publication (Pagnon et al. 2022).

    Each point is triangulated from all its views by a DLT whose equations are weighted with the
    confidence. While its mean reprojection error exceeds ``largest_error`` (pixels), all subsets
    with one view fewer are tried, and the best one is taken. A point that no subset explains is
    missing. Views below ``least_confidence`` do not count. A step of more than ``most_subsets``
    subsets, which ten views or more have, is not tried.
    """

    largest_error: float
    least_confidence: float
    most_subsets: int

    def __post_init__(self) -> None:
        check_positive(largest_error=self.largest_error, most_subsets=self.most_subsets)

    def triangulate(self, batch: Observations) -> Triangulation:
        frames, views, joints = batch.valid.shape
        matrix = _projection_metres(batch)
        matrices = matrix[:, None].expand(frames, joints, views, 3, 4).flatten(0, 1)
        shown = where(batch.valid, batch.key_points.double(), 0.0)
        pixels = shown.transpose(1, 2).flatten(0, 1)
        confidence = batch.confidence.double()
        counts = batch.valid & (confidence >= self.least_confidence)
        weight = torch.where(counts, confidence, 0.0).transpose(1, 2).flatten(0, 1)
        points = pixels.new_full((frames * joints, 3), torch.nan)
        used = torch.zeros_like(weight, dtype=torch.bool)
        for subsets in self._steps(views):
            excluded = views - int(subsets[0].sum())
            waiting = points[:, 0].isnan() & ((weight > 0).sum(-1) - excluded >= 2)
            at_once = max(1, _MOST_ROWS // (len(subsets) * 2 * views))
            for rows in torch.nonzero(waiting)[:, 0].split(at_once):
                self._solve(matrices, pixels, weight, subsets, rows, points, used)
        return _with_points(
            batch,
            1000.0 * points.unflatten(0, (frames, joints)),
            used.unflatten(0, (frames, joints)).transpose(1, 2),
        )

    def _steps(self, views: int) -> Iterator[Bool[Tensor, "S V"]]:
        """Yield the subsets of views without none, one, two, ... of them."""
        for excluded in range(views - 1):
            if comb(views, excluded) > self.most_subsets:
                return
            subsets = torch.ones(comb(views, excluded), views, dtype=torch.bool)
            for subset, out in zip(subsets, combinations(range(views), excluded), strict=True):
                subset[list(out)] = False
            yield subsets

    def _solve(
        self,
        matrices: Float[Tensor, "N V 3 4"],
        pixels: Float[Tensor, "N V 2"],
        weight: Float[Tensor, "N V"],
        subsets: Bool[Tensor, "S V"],
        rows: Int[Tensor, " n"],
        points: Float[Tensor, "N 3"],
        used: Bool[Tensor, "N V"],
    ) -> None:
        """Put the points of these rows that a subset explains, and its views, where they belong."""
        chosen = torch.where(subsets, weight[rows, None], 0.0)
        found, error = _weighted_dlt(matrices[rows, None], pixels[rows, None], chosen)
        least, best = error.min(-1)
        good = least <= self.largest_error
        points[rows[good]] = found[good, best[good]]
        used[rows[good]] = chosen[good, best[good]] > 0


def _projection_metres(batch: Observations) -> Float[Tensor, "B V 3 4"]:
    """Return K [R | t] with t in metres, as Pose2Sim's files have it."""
    cameras = batch.cameras.to(torch.float64)
    return cameras.K @ torch.cat((cameras.R, cameras.t[..., None] / 1000.0), dim=-1)


def _weighted_dlt(
    matrix: Float[Tensor, "*N V 3 4"],
    pixels: Float[Tensor, "*N V 2"],
    weight: Float[Tensor, "*S V"],
) -> tuple[Float[Tensor, "*S 3"], Float[Tensor, "*S"]]:
    """Return points, and their mean reprojection error over the views of weight above 0."""
    rows = pixels[..., None] * matrix[..., 2:, :] - matrix[..., :2, :]
    equations = (weight[..., None, None] * rows).flatten(-3, -2)
    solution = torch.linalg.svd(equations, full_matrices=False).Vh[..., -1, :]
    image = torch.einsum("...vij,...j->...vi", matrix.expand(*weight.shape, 3, 4), solution)
    offset = image[..., :2] / image[..., 2:] - pixels
    distance = where(weight > 0, offset.norm(dim=-1), 0.0)
    error = distance.sum(-1) / (weight > 0).sum(-1)
    return solution[..., :3] / solution[..., 3:], error.nan_to_num(torch.inf)


@dataclass(frozen=True)
class Aniposelib(Estimator):
    """The triangulation of aniposelib-pytorch, on the CPU.

    ``threshold`` (pixels): of its robust triangulation, the largest error of an inlier; None: from
    all views with equal weights.
    """

    threshold: float | None

    def __post_init__(self) -> None:
        check_installed("aniposelib", "aniposelib")
        if self.threshold is not None:
            check_positive(threshold=self.threshold)

    def triangulate(self, batch: Observations) -> Triangulation:
        from aniposelib.init import from_extrinsics

        frames, _, joints = batch.valid.shape
        cameras = batch.cameras.index(0).to("cpu", torch.float64)
        pose = torch.cat((cameras.R, cameras.t[..., None]), dim=-1)
        last_row = pose.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(pose), 1, 4)
        names = [f"c{view}" for view in range(len(pose))]
        matrices = torch.cat((pose, last_row), dim=1).numpy()
        group = from_extrinsics(names, matrices, K=cameras.K.numpy())
        shown = where(batch.valid, batch.key_points.double(), torch.nan)
        pixels = shown.transpose(0, 1).cpu().numpy()
        if self.threshold is None:
            found = group.triangulate(pixels)
        else:
            found = group.triangulate_robust(pixels, tau=self.threshold).p3d
        points = torch.from_numpy(np.asarray(found, np.float64)).reshape(frames, joints, 3)
        return _with_points(batch, points.to(batch.key_points.device), batch.valid)


def _with_points(
    batch: Observations, points: Float[Tensor, "B J 3"], used: Bool[Tensor, "B V J"]
) -> Triangulation:
    """Return points (mm, NaN where there is none) that were made of these views.

    Angle, depth and condition are those of our triangulation from the same views.
    """
    ours = triangulate(batch.cameras, batch.key_points, used.to(batch.key_points.dtype))
    found = points.isfinite().all(-1)
    enough = batch.valid.sum(1) >= 2
    missing = torch.where(enough, int(State.REJECTED), int(State.FEW_VIEWS))
    status = torch.where(found, int(State.OBSERVED), missing).to(ours.status.dtype)
    return Triangulation(
        points=where(found, points, 0.0),
        status=status,
        angle=ours.angle,
        depth_min=ours.depth_min,
        cond=ours.cond,
    )
