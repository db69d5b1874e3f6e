"""Lengths and directions by a person's own body, so that all people and cameras compare."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.skeleton import BONES, JOINT, JOINTS, PELVIS, THORAX

UNIT = 0.005
"""Of a stature: about the error of a good detector."""
_STATURE = 1700.0
"""mm: of a person whose bones are not known."""
_SHARES = {
    frozenset(("ankle", "knee")): 0.246,
    frozenset(("knee", "hip")): 0.245,
    frozenset(("hip", "pelvis")): 0.074,
    frozenset(("pelvis", "spine")): 0.139,
    frozenset(("spine", "thorax")): 0.151,
    frozenset(("thorax", "head_top")): 0.136,
    frozenset(("head_top", "nose")): 0.079,
    frozenset(("thorax", "shoulder")): 0.104,
    frozenset(("shoulder", "elbow")): 0.172,
    frozenset(("elbow", "wrist")): 0.146,
}
"""Lengths of bones in statures (ghpt.data.synthetic.body)."""


def kind(joint: str) -> str:
    """Return a joint's name without its side."""
    return joint.removeprefix("right_").removeprefix("left_")


KINDS = tuple(dict.fromkeys(kind(joint) for joint in JOINTS))
"""The joints without their sides."""
BONE_SHARES = tuple(_SHARES[frozenset((kind(JOINTS[a]), kind(JOINTS[b])))] for a, b in BONES)
"""Length of each bone in statures."""


def log_length(length: Tensor) -> Tensor:
    """Return the logarithm of a length in units; one far below a unit is none."""
    return (length + 0.05).log()


def stature(points: Float[Tensor, "B J 3"], estimated: Bool[Tensor, "B J"]) -> Float[Tensor, " B"]:
    """Return the stature that the median bone has, mm."""
    start = [a for a, _ in BONES]
    end = [b for _, b in BONES]
    length = (points[:, start] - points[:, end]).norm(dim=-1)
    complete = estimated[:, start] & estimated[:, end]
    ratio = length / length.new_tensor(BONE_SHARES)
    median = torch.where(complete, ratio, torch.nan).nanmedian(-1).values
    return median.nan_to_num(_STATURE).clamp(0.3 * _STATURE, 3 * _STATURE)


def trunk_axes(
    points: Float[Tensor, "B J 3"], estimated: Bool[Tensor, "B J"]
) -> tuple[Float[Tensor, "B 3 3"], Bool[Tensor, " B"]]:
    """Return the directions forward, left and up of each trunk, as rows, and where there is one."""
    up = points[:, THORAX] - points[:, PELVIS]
    across = points[:, JOINT["left_hip"]] - points[:, JOINT["right_hip"]]
    up = torch.nn.functional.normalize(up, dim=-1)
    forward = torch.nn.functional.normalize(torch.linalg.cross(across, up), dim=-1)
    left = torch.linalg.cross(up, forward)
    needed = [PELVIS, THORAX, JOINT["left_hip"], JOINT["right_hip"]]
    return torch.stack((forward, left, up), dim=1), estimated[:, needed].all(-1)
