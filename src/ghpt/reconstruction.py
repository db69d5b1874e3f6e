"""What a recording becomes: 3D joints in which every number says whether it was seen, filled or is
missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, Int8
from torch import Tensor

from ghpt.geometry.state import FILE_STATES, State
from ghpt.skeleton import HUMAN36M, NamePair

__all__ = ["FILE_STATES", "About", "Reconstruction", "State", "concatenate", "move_to_cpu"]


@dataclass(frozen=True)
class About:
    """What holds for all frames of a reconstruction."""

    name: str
    source: str
    """``synthetic`` or the path of the key points."""
    estimator: str
    """``weight`` of a checkpoint, or a classical estimator's name."""
    joints: tuple[str, ...]
    camera_names: tuple[str, ...]
    rate_hz: float | None
    smoothed: bool
    provenance: dict[str, Any]
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The point of the world (mm) that formats of single precision take for their zero: near the
    rig where that is far away."""
    world: str = "the cameras' own"
    """Whose axes the positions have, in words."""
    bones: tuple[NamePair, ...] = HUMAN36M.bone_names
    """What pictures draw between joints, by name; those without both ends are not there."""


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

    def select_joints(self, joints: Int[Tensor, " j"]) -> Reconstruction:
        """Return some of the joints, in this order."""
        chosen = {name: getattr(self, name).index_select(axis, joints) for name, axis in _AXIS}
        return replace(self, **chosen)

    def with_joints(self, other: Reconstruction) -> Reconstruction:
        """Return the joints of both, of the same frames."""
        pairs = [(name, (getattr(self, name), getattr(other, name)), axis) for name, axis in _AXIS]
        return replace(self, **{name: torch.cat(both, axis) for name, both, axis in pairs})

    @property
    def has_position(self) -> Bool[Tensor, "T J"]:
        """Joints that have a position."""
        return self.state <= State.FILLED

    @property
    def is_measured(self) -> Bool[Tensor, "T J"]:
        """Joints that views made: observed, or supported. They have an error and a covariance."""
        return self.state <= State.SUPPORTED


_AXIS = (("points", 1), ("state", 1), ("error", 1), ("views", 2), ("covariance", 1))
"""The fields with a value for each joint, and the dimension that the joints are."""


def select_frames(part: Reconstruction, rows: Int[Tensor, " N"]) -> Reconstruction:
    """Return some of the frames, in this order."""
    values = {field.name: getattr(part, field.name)[rows] for field in fields(Reconstruction)}
    return Reconstruction(**values)


def move_to_cpu(part: Reconstruction) -> Reconstruction:
    """Return the reconstruction in the memory of the CPU."""
    values = {field.name: getattr(part, field.name).cpu() for field in fields(Reconstruction)}
    return Reconstruction(**values)


def concatenate(parts: Sequence[Reconstruction]) -> Reconstruction:
    """Return successive parts as one."""
    values = {}
    for field in fields(Reconstruction):
        values[field.name] = torch.cat([getattr(part, field.name) for part in parts])
    return Reconstruction(**values)
