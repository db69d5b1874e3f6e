"""Where a camera would have to stand: its pose from the points that the other views give."""

from __future__ import annotations

import numpy as np
import poselib
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.calibration.check.setup import Rays
from ghpt.calibration.pairs import camera_dict, ransac_options

_LEAST = 20
"""Points."""


def resect(
    rays: Rays,
    points: Float[Tensor, "F J 3"],
    known: Bool[Tensor, "F J"],
    threshold: float,
    seed: int,
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, " 3"]] | None:
    """R, t of one view by PnP with LO-RANSAC; an inlier's error is at most ``threshold`` sizes of
    the person. None where nothing agrees.
    """
    used = rays.valid & known & (rays.size > 0)[:, None]
    if int(used.sum()) < _LEAST:
        return None
    typical = float(rays.size[rays.size > 0].median())
    pose, info = poselib.estimate_absolute_pose(
        (rays.xy[used] / typical).numpy(),
        points[used].numpy(),
        camera_dict(1 / typical),
        ransac_options(threshold, 1000, seed, "max_reproj_error"),
        {"loss_type": "CAUCHY", "loss_scale": threshold / 4},
    )
    R = torch.from_numpy(np.array(pose.R))
    t = torch.from_numpy(np.array(pose.t))
    enough = sum(info["inliers"]) >= _LEAST and bool(
        torch.isfinite(R).all() & torch.isfinite(t).all()
    )
    return (R, t) if enough else None
