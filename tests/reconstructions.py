"""Random reconstructions with every state, for tests of what is written of them."""

import numpy as np
import torch

from ghpt.reconstruction import About, Reconstruction, State
from ghpt.skeleton import JOINTS
from toys import recording


def about(joints=JOINTS, cameras=("cam_1", "cam_2", "cam_3"), rate_hz=29.97):
    return About(
        name="S1/Walking-1",
        source="synthetic",
        estimator="huber",
        joints=tuple(joints),
        camera_names=tuple(cameras),
        rate_hz=rate_hz,
        smoothed=False,
        provenance={"seed": 3, "commit": "abc"},
    )


def random_reconstruction(frames, joints=17, views=3, seed=0, missing=0.3, first=0):
    """``missing`` of the joints in a missing state, others observed or filled; all numbers
    finite."""
    g = torch.Generator().manual_seed(seed)
    state = torch.randint(2, max(State) + 1, (frames, joints), generator=g, dtype=torch.int8)
    there = torch.rand(frames, joints, generator=g) >= missing
    filled = torch.rand(frames, joints, generator=g) < 0.2
    state = torch.where(there, filled.to(torch.int8), state)
    observed = state == State.OBSERVED
    covariance = torch.rand(frames, joints, 6, generator=g) * 100 * observed[..., None]
    return Reconstruction(
        frame=torch.arange(first, first + frames),
        # made of float32, so that C3D holds them exactly
        points=(torch.randn(frames, joints, 3, generator=g) * 1500).double(),
        state=state,
        error=torch.rand(frames, joints, generator=g) * 20 * observed,
        views=(torch.rand(frames, views, joints, generator=g) < 0.7) & observed[:, None],
        covariance=covariance,
        score=torch.randn(frames, generator=g),
        flipped=torch.rand(frames, views, generator=g) < 0.1,
    )


def in_parts(*parts):
    """Chunks of these parts, in this order."""
    return lambda: iter(parts)


def rig(views):
    """Cameras around the origin."""
    return recording("toy", "S1", 1, views, 0.0, np.random.default_rng(0)).cameras
