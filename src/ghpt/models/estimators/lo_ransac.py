"""LO-RANSAC of pycolmap, joint by joint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.errors import check_positive
from ghpt.extras import check_installed
from ghpt.geometry.cameras import Cameras
from ghpt.geometry.normal_equations import valid_key_points
from ghpt.geometry.triangulation import Triangulation, triangulate
from ghpt.models.estimators.classical import (
    ConfidenceWeighted,
    Linear,
    fall_back,
    fill_frames,
    person_scale,
)
from ghpt.observations import Observations


@dataclass(frozen=True)
class LoRansac(ConfidenceWeighted):
    """pycolmap's LO-RANSAC over views for each joint, and its inliers triangulated together.

    ``threshold``: an inlier's largest reprojection error, as a fraction of the person's scale in
    that view. ``seed`` fixes its draws. Runs on the CPU, joint by joint.
    """

    threshold: float
    seed: int

    def __post_init__(self) -> None:
        check_installed("pycolmap", "LO-RANSAC")
        check_positive(threshold=self.threshold)

    def inlier_threshold(
        self, batch: Observations, points: Float[Tensor, "B J 3"]
    ) -> Float[Tensor, " B"]:
        return fill_frames(self.threshold, batch)

    def triangulate(self, batch: Observations) -> Triangulation:
        valid = batch.valid & valid_key_points(batch.cameras, batch.key_points)
        scale = person_scale(batch.key_points, valid).double()
        valid &= (scale > 0)[..., None]
        # in units of the person's scale one threshold holds for all views
        K = batch.cameras.K.double() / torch.where(scale > 0, scale, 1.0)[..., None, None]
        key_points = batch.key_points.double() / scale.clamp(min=1e-12)[..., None, None]
        rig = Cameras(K, batch.cameras.R, batch.cameras.t).to("cpu", torch.float64)
        inliers = self._find_inliers(rig, key_points.cpu().numpy(), valid.cpu().numpy())
        weights = inliers.to(batch.key_points.device) * self.confidence_weights(batch)
        robust = triangulate(batch.cameras, batch.key_points, weights)
        return fall_back(robust, Linear().triangulate(batch))

    def _find_inliers(
        self,
        cameras: Cameras,
        key_points: Float[np.ndarray, "B V J 2"],
        valid: Bool[np.ndarray, "B V J"],
    ) -> Bool[Tensor, "B V J"]:
        from ghpt.colmap import pycolmap

        options = pycolmap.EstimateTriangulationOptions()
        options.residual_type = pycolmap.TriangulationResidualType.REPROJECTION_ERROR
        options.ransac.max_error = self.threshold
        options.ransac.random_seed = self.seed
        inliers = torch.zeros(valid.shape, dtype=torch.bool)
        for frame in range(len(valid)):
            intrinsics, poses = pycolmap_cameras(cameras.index(frame), valid[frame].any(-1))
            for joint in range(valid.shape[-1]):
                views = np.flatnonzero(valid[frame, :, joint]).tolist()
                if len(views) < 2:
                    continue
                found = pycolmap.estimate_triangulation(
                    key_points[frame, views, joint],
                    [poses[view] for view in views],
                    [intrinsics[view] for view in views],
                    options,
                )
                if found is not None:
                    mask = np.asarray(found["inliers"], dtype=bool)
                    inliers[frame, np.array(views)[mask], joint] = True
        return inliers


def pycolmap_cameras(
    cameras: Cameras, valid: Bool[np.ndarray, " V"]
) -> tuple[dict[int, Any], dict[int, Any]]:
    """Return pycolmap's Camera and Rigid3d of each valid view: it refuses others."""
    from ghpt.colmap import pycolmap

    K = cameras.K.numpy()
    intrinsics = {}
    poses = {}
    for view in np.flatnonzero(valid).tolist():
        pinhole = [K[view, 0, 0], K[view, 1, 1], K[view, 0, 2], K[view, 1, 2]]
        camera = pycolmap.Camera(model="PINHOLE", width=1, height=1, params=pinhole)
        rotation = pycolmap.Rotation3d(cameras.R[view].numpy())
        intrinsics[view] = camera
        poses[view] = pycolmap.Rigid3d(rotation, cameras.t[view].numpy())
    return intrinsics, poses
