"""What a recording becomes: 3D joints in which every number says whether it was seen, filled or is
missing.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from jaxtyping import Bool, Float, Int, Int8
from torch import Tensor


class State(IntEnum):
    """What a joint of a frame is. Only OBSERVED and FILLED joints have a position."""

    OBSERVED = 0
    """Triangulated from this frame's key points."""
    FILLED = 1
    """Interpolated between observed frames, on request."""
    FEW_VIEWS = 2
    """Missing: fewer than two views see it."""
    PARALLEL = 3
    """Missing: the rays that see it fix no point."""
    BEHIND = 4
    """Missing: its rays meet behind a camera."""
    BAD_INPUT = 5
    """Missing: a key point or camera is not finite or absurd."""
    REJECTED = 6
    """Missing: no two views explain it, so wherever it were put would be made up."""


@dataclass(frozen=True)
class About:
    """What holds for all frames of a reconstruction."""

    name: str
    source: str
    """``synthetic`` or the path of the key points."""
    estimator: str
    """``view_weights`` of a checkpoint, or a classical estimator's name."""
    joints: tuple[str, ...]
    camera_names: tuple[str, ...]
    rate_hz: float | None
    smoothed: bool
    provenance: dict[str, Any]
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The point of the world (mm) that formats of single precision take for their zero: near the
    rig where that is far away."""


@dataclass(frozen=True)
class Reconstruction:
    """T successive frames, J joints, V views."""

    frame: Int[Tensor, " T"]
    """The recording's own frame numbers, rising; a number that is left out has no frame."""
    points: Float[Tensor, "T J 3"]
    """World, mm, float64; finite and meaningless where missing (NaN in files)."""
    state: Int8[Tensor, "T J"]
    """Values of ``State``."""
    error: Float[Tensor, "T J"]
    """Root mean square reprojection error over the used views, pixels; 0 where nothing was
    observed.
    """
    views: Bool[Tensor, "T V J"]
    """The views that made the joint."""
    covariance: Float[Tensor, "T J 6"]
    """xx xy xz yy yz zz of the position, mm^2; 0 where nothing was observed."""
    score: Float[Tensor, " T"]
    """Mean logit of the pool under its weights for a learned estimator: higher is more plausible; 0
    for others.
    """
    flipped: Bool[Tensor, "T V"]
    """Views in which left and right were exchanged before triangulating."""

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def placed(self) -> Bool[Tensor, "T J"]:
        """Joints that have a position."""
        return self.state <= State.FILLED
