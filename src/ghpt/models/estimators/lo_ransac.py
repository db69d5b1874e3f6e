"""LO-RANSAC of pycolmap, joint by joint."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ghpt.colmap import pycolmap
from ghpt.errors import check_positive
from ghpt.geometry.normal_equations import valid_key_points
from ghpt.geometry.triangulation import Triangulation, triangulate
from ghpt.models.estimators.classical import Estimator, Linear, everywhere, otherwise, person_scale
from ghpt.observations import Observations


@dataclass(frozen=True)
class LoRansac(Estimator):
    """pycolmap's LO-RANSAC over views for each joint, and its inliers triangulated together.

    ``threshold``: an inlier's largest reprojection error, as a fraction of the person's size in
    that view. ``seed`` fixes its draws. Runs on the CPU, joint by joint.
    """

    threshold: float
    seed: int

    def __post_init__(self) -> None:
        check_positive(threshold=self.threshold)

    def inlier_threshold(
        self, batch: Observations, points: Float[Tensor, "B J 3"]
    ) -> Float[Tensor, " B"]:
        return everywhere(self.threshold, batch)

    def triangulate(self, batch: Observations) -> Triangulation:
        usable = batch.valid & valid_key_points(batch.cameras, batch.key_points)
        size = person_scale(batch.key_points, usable).double()
        usable &= (size > 0)[..., None]
        # in units of the person's size one threshold holds for all views
        K = batch.cameras.K.double() / torch.where(size > 0, size, 1.0)[..., None, None]
        rays = (batch.key_points.double() / size.clamp(min=1e-12)[..., None, None]).cpu().numpy()
        inliers = torch.zeros_like(batch.valid, device="cpu")
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
                    rays[frame, views, joint],
                    [poses[v] for v in views],
                    [cameras[v] for v in views],
                    options,
                )
                if found is not None:
                    inliers[frame, views[np.asarray(found["inliers"], dtype=bool)], joint] = True
        weights = inliers.to(batch.key_points)
        return otherwise(
            triangulate(batch.cameras, batch.key_points, weights), Linear().triangulate(batch)
        )


def pycolmap_cameras(
    K: np.ndarray, R: np.ndarray, t: np.ndarray, valid: np.ndarray
) -> tuple[dict[int, pycolmap.Camera], dict[int, pycolmap.Rigid3d]]:
    """The valid cameras by view: pycolmap refuses others."""
    cameras = {}
    poses = {}
    for v in np.flatnonzero(valid).tolist():
        pinhole = [K[v, 0, 0], K[v, 1, 1], K[v, 0, 2], K[v, 1, 2]]
        cameras[v] = pycolmap.Camera(model="PINHOLE", width=1, height=1, params=pinhole)
        poses[v] = pycolmap.Rigid3d(pycolmap.Rotation3d(R[v]), t[v])
    return cameras, poses
