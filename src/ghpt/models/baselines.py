"""Classical estimators on the same key points as the learned one, and with the same output type.

Thresholds and scales are fractions of the person's size in each view's image (the diagonal of the box of the
seen key points), so that they mean the same at any resolution and distance. A robust estimator that finds
nothing better falls back to the all-view linear one: it never gains by leaving hard joints out.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np
import pycolmap
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.errors import check
from ghpt.geometry.cameras import Cameras
from ghpt.geometry.normal_equations import usable_views
from ghpt.geometry.reweighting import WEIGHTS, triangulate_robustly
from ghpt.geometry.triangulation import (
    Status,
    System,
    Triangulation,
    flat_cameras,
    in_parts,
    triangulate,
    triangulate_subsets,
)
from ghpt.randomness import key, uniform
from ghpt.recording import KeyPointBatch, PoseEstimate


def person_size(key_points: Float[Tensor, "*B V J 2"], seen: Bool[Tensor, "*B V J"]) -> Float[Tensor, "*B V"]:
    """Diagonal (pixels) of the box around the seen key points of each view; 0 where fewer than two are
    seen."""
    seen = (seen & torch.isfinite(key_points).all(-1))[..., None]
    largest = torch.where(seen, key_points, -torch.inf).amax(-2)
    smallest = torch.where(seen, key_points, torch.inf).amin(-2)
    return torch.where(seen.any(-2), largest - smallest, 0.0).norm(dim=-1)


def _otherwise(first: Triangulation, second: Triangulation) -> Triangulation:
    """``first`` where it is ok, ``second`` elsewhere."""
    chosen = {}
    for field in fields(Triangulation):
        a, b = getattr(first, field.name), getattr(second, field.name)
        chosen[field.name] = torch.where(first.ok[..., None] if a.ndim > first.ok.ndim else first.ok, a, b)
    return Triangulation(**chosen)


def _check_positive(**values: float | int) -> None:
    for name, value in values.items():
        check(value > 0, name, f"is {value}", "It must be > 0.")


class Baseline(ABC):
    """A classical estimator: ``baseline(batch)`` gives a PoseEstimate in the dtype of the key points."""

    @abstractmethod
    def triangulate(self, batch: KeyPointBatch) -> Triangulation:
        """The batch's joints with their status."""

    @property
    def reach(self) -> float | None:
        """Largest residual of a view that counts as one that made the joint, as a fraction of the person's size; None
        where all views do."""
        return None

    @torch.no_grad()
    def __call__(self, batch: KeyPointBatch) -> PoseEstimate:
        result = self.triangulate(batch)
        estimated = result.ok | (result.status == Status.NOT_CONVERGED)
        return PoseEstimate(result.points.to(batch.key_points.dtype), estimated)


class Linear(Baseline):
    """All seen views with equal weights."""

    def triangulate(self, batch: KeyPointBatch) -> Triangulation:
        return triangulate(batch.cameras, batch.key_points, batch.seen.to(batch.key_points.dtype))


@dataclass(frozen=True)
class WeightedLinear(Baseline):
    """All seen views; the detector's confidence to the power ``power`` weights the squared residuals."""

    power: float

    def __post_init__(self) -> None:
        _check_positive(power=self.power)

    def triangulate(self, batch: KeyPointBatch) -> Triangulation:
        weights = torch.where(batch.seen, batch.confidence.clamp(min=0) ** self.power, 0.0)
        return _otherwise(triangulate(batch.cameras, batch.key_points, weights), Linear().triangulate(batch))


@dataclass(frozen=True)
class Ransac(Baseline):
    """For each joint the pair of views whose point has the most inliers (least residual among equals), then
    the inliers together.

    ``threshold``: an inlier's largest reprojection error, as a fraction of the person's size in that view.
    ``pairs``: where the views make more pairs than this, so many random ones are tried for each joint, keyed
    by ``seed`` and the sample.
    """

    threshold: float
    pairs: int
    seed: int

    def __post_init__(self) -> None:
        _check_positive(threshold=self.threshold, pairs=self.pairs)

    @property
    def reach(self) -> float:
        return self.threshold

    def triangulate(self, batch: KeyPointBatch) -> Triangulation:
        rig = flat_cameras(batch.cameras, batch.seen.shape[:1])
        limit = (self.threshold * person_size(batch.key_points, batch.seen)).clamp(min=1e-12)
        candidates = self._pairs(batch)

        def part(rows: slice) -> tuple[Tensor, ...]:
            own = rig if len(rig.t) == 1 else rig.index(rows)
            return (self._inliers(own, batch.key_points[rows], batch.seen[rows], limit[rows], candidates[rows]),)

        frames, views, joints = batch.seen.shape
        (inlier,) = in_parts(part, torch.Size((frames, max(views, candidates.shape[1]), joints)))
        robust = triangulate(batch.cameras, batch.key_points, inlier.to(batch.key_points.dtype))
        return _otherwise(robust, Linear().triangulate(batch))

    def _inliers(
        self, cameras: Cameras, key_points: Tensor, seen: Bool[Tensor, "B V J"], limit: Tensor, pairs: Tensor
    ) -> Bool[Tensor, "B V J"]:
        """The inliers of each joint's best pair."""
        whole = Cameras(*(x.expand(len(seen), *x.shape[1:]) for x in (cameras.K, cameras.R, cameras.t)))
        points, ok = triangulate_subsets(whole, key_points, seen, pairs)
        system = System(cameras, key_points, seen.permute(1, 2, 0))
        square = torch.where(system.used, limit.double().mT[:, None] ** 2, 0.0)
        ok, points = ok.permute(1, 2, 0), (points - system.origin[:, None, None]).permute(3, 1, 2, 0).contiguous()
        count, rest = torch.zeros(ok.shape, dtype=points.dtype, device=ok.device), 0.0
        for view in range(len(square)):
            residual = system.square_residuals(points, square, view)
            inlier = ok & (residual <= 1)
            count += inlier
            rest = rest + torch.where(inlier, residual.sqrt(), 0.0)
        # the residuals sum up to less than one more inlier
        best = (count - rest / (len(square) + 1)).argmax(0)[None]
        chosen, right = (x.gather(-3, best.expand(*x.shape[:-3], 1, -1, -1)).squeeze(-3) for x in (points, ok))
        return torch.stack(
            [right & (system.square_residuals(chosen, square, view) <= 1) for view in range(len(square))]
        ).permute(2, 0, 1)

    def _pairs(self, batch: KeyPointBatch) -> Bool[Tensor, "B P J V"]:
        """Pairs of seen views: each pair of the rig if they are few, else random ones."""
        frames, views, joints = batch.seen.shape
        device = batch.seen.device
        if views * (views - 1) // 2 <= self.pairs:
            one, other = torch.triu_indices(views, views, offset=1, device=device)
            eye = torch.eye(views, dtype=torch.bool, device=device)
            return (eye[one] | eye[other])[None, :, None].expand(frames, -1, joints, -1)
        seen = batch.seen.mT[:, None]
        count = seen.sum(-1)
        draw = uniform(key(self.seed, "ransac", batch.sample, device=device), (self.pairs, joints, 2))
        one = (draw[..., 0] * count).long()
        other = (draw[..., 1] * (count - 1)).long()
        other = other + (other >= one)
        place = seen.cumsum(-1) - 1
        return seen & ((place == one[..., None]) | (place == other[..., None]))


@dataclass(frozen=True)
class MEstimator(Baseline):
    """Iteratively reweighted least squares on the reprojection error, from the linear estimate.

    ``scale``: where the loss turns robust, as a fraction of the person's size in each view. Each view's
    weight is that of its residual under ``loss`` over its squared depth, which turns the rows' residuals into
    pixels. A joint whose last step is longer than ``tolerance`` (mm) has the status NOT_CONVERGED and its
    last point.
    """

    loss: Literal["huber", "cauchy", "geman_mcclure"]
    scale: float
    iterations: int
    tolerance: float

    def __post_init__(self) -> None:
        check(self.loss in WEIGHTS, "loss", f"is {self.loss!r}", f"Choose from {', '.join(WEIGHTS)}.")
        _check_positive(scale=self.scale, iterations=self.iterations, tolerance=self.tolerance)

    @property
    def reach(self) -> float:
        """The scale: a residual of that size has a quarter (Geman-McClure), half (Cauchy) or all (Huber) of the
        weight."""
        return self.scale

    def triangulate(self, batch: KeyPointBatch) -> Triangulation:
        scale = (self.scale * person_size(batch.key_points, batch.seen)).clamp(min=1e-12)
        return triangulate_robustly(
            batch.cameras, batch.key_points, batch.seen, scale, WEIGHTS[self.loss], self.iterations, self.tolerance
        )


@dataclass(frozen=True)
class LoRansac(Baseline):
    """pycolmap's LO-RANSAC over views for each joint, and its inliers triangulated together.

    ``threshold``: an inlier's largest reprojection error, as a fraction of the person's size in that view.
    ``seed`` fixes its draws. Runs on the CPU, joint by joint.
    """

    threshold: float
    seed: int

    def __post_init__(self) -> None:
        _check_positive(threshold=self.threshold)

    @property
    def reach(self) -> float:
        return self.threshold

    def triangulate(self, batch: KeyPointBatch) -> Triangulation:
        usable = batch.seen & usable_views(batch.cameras, batch.key_points)
        size = person_size(batch.key_points, usable).double()
        usable &= (size > 0)[..., None]
        # in units of the person's size one threshold holds for all views
        K = batch.cameras.K.double() / torch.where(size > 0, size, 1.0)[..., None, None]
        rays = (batch.key_points.double() / size.clamp(min=1e-12)[..., None, None]).cpu().numpy()
        inliers = torch.zeros_like(batch.seen, device="cpu")
        options = pycolmap.EstimateTriangulationOptions()
        options.residual_type = pycolmap.TriangulationResidualType.REPROJECTION_ERROR
        options.ransac.max_error = self.threshold
        options.ransac.random_seed = self.seed
        rig = [x.double().cpu().numpy() for x in (K, batch.cameras.R, batch.cameras.t)]
        mask = usable.cpu().numpy()
        for frame in range(len(batch)):
            cameras, poses = pycolmap_cameras(*(x[frame] for x in rig), mask[frame].any(-1))
            for joint in range(mask.shape[-1]):
                views = np.flatnonzero(mask[frame, :, joint])
                if len(views) < 2:
                    continue
                found = pycolmap.estimate_triangulation(
                    rays[frame, views, joint], [poses[v] for v in views], [cameras[v] for v in views], options
                )
                if found is not None:
                    inliers[frame, views[np.asarray(found["inliers"], dtype=bool)], joint] = True
        weights = inliers.to(batch.key_points)
        return _otherwise(triangulate(batch.cameras, batch.key_points, weights), Linear().triangulate(batch))


def pycolmap_cameras(
    K: np.ndarray, R: np.ndarray, t: np.ndarray, valid: np.ndarray
) -> tuple[dict[int, pycolmap.Camera], dict[int, pycolmap.Rigid3d]]:
    """The valid cameras by view: pycolmap refuses others."""
    cameras, poses = {}, {}
    for v in np.flatnonzero(valid).tolist():
        pinhole = [K[v, 0, 0], K[v, 1, 1], K[v, 0, 2], K[v, 1, 2]]
        cameras[v] = pycolmap.Camera(model="PINHOLE", width=1, height=1, params=pinhole)
        poses[v] = pycolmap.Rigid3d(pycolmap.Rotation3d(R[v]), t[v])
    return cameras, poses
