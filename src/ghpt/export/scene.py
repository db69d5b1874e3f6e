"""What pictures of a reconstruction show besides it: the cameras, what they saw, and which way is
up.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.geometry.cameras import Cameras
from ghpt.reconstruction import About, Reconstruction
from ghpt.skeleton import BONES, JOINTS


class Evidence(NamedTuple):
    """What a part of a reconstruction was made of, frame by frame."""

    key_points: Float[Tensor, "T V J 2"]
    """Undistorted pixels."""
    valid: Bool[Tensor, "T V J"]
    hypotheses: Float[Tensor, "T H J 3"] | None
    """World, mm; those of the pool that are worth a look."""


@dataclass(frozen=True)
class Scene:
    """For pictures."""

    cameras: Cameras
    """The views, in the order of ``About.camera_names``; leading dimension V."""
    evidence: Callable[[], Iterator[Evidence]] | None = None
    """In parts as long as those of the reconstruction."""


def title(about: About) -> str:
    """Of a picture; says where the data are not real."""
    return f"{about.name}: 3D poses from {'synthetic data' if about.source == 'synthetic' else about.source}"


def origin_note(about: About) -> str:
    """Where a picture's zero is, in words; nothing where it is the world's own."""
    place = ", ".join(f"{x:.15g}" for x in about.origin)
    return f"zero is at ({place}) mm of the cameras' world" if any(about.origin) else ""


def bones_of(joints: tuple[str, ...]) -> list[tuple[int, int]]:
    """The skeleton's bones whose ends are among these joints."""
    named = ((JOINTS[a], JOINTS[b]) for a, b in BONES)
    return [(joints.index(a), joints.index(b)) for a, b in named if a in joints and b in joints]


def side_of(joint: str) -> str:
    """left, right or middle."""
    return next((side for side in ("left", "right") if side in joint.lower()), "middle")


def upright(joints: tuple[str, ...], piece: Reconstruction) -> Float[Tensor, " 3"]:
    """The sum over the frames of the way from pelvis to thorax, mm; 0 where there is none."""
    if not {"pelvis", "thorax"} <= set(joints):
        return torch.zeros(3, dtype=torch.float64)
    ends = [joints.index("pelvis"), joints.index("thorax")]
    both = piece.has_position[:, ends].all(1)
    way = piece.points[both][:, ends].double()
    return (way[:, 1] - way[:, 0]).sum(0)


def to_z_up(up: Float[Tensor, " 3"]) -> Float[Tensor, "3 3"]:
    """The rotation that brings the world's axis nearest to ``up``, with its sign, to z; none for 0."""
    axis = int(up.abs().argmax()) if up.any() else 2
    z = torch.zeros(3, dtype=torch.float64)
    z[axis] = -1.0 if up[axis] < 0 else 1.0
    x = torch.zeros(3, dtype=torch.float64)
    x[1 if axis == 0 else 0] = 1.0
    return torch.stack([x, torch.linalg.cross(z, x), z])


def frustum(cameras: Cameras, depth: float) -> Float[Tensor, "V 4 3"]:
    """World corners, ``depth`` mm before each camera, of an image whose middle is the principal
    point.
    """
    c = cameras.K[:, :2, 2]
    corners = torch.stack(
        [c * c.new_tensor(s) for s in ((0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0))], dim=1
    )
    rays = (
        torch.cat([corners, torch.ones_like(corners[..., :1])], dim=-1)
        @ torch.linalg.inv(cameras.K).mT
    )
    return (depth * rays - cameras.t[:, None]) @ cameras.R
