"""The joints of CMU Panoptic's truth, and the 17 that are made of them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from ghpt.skeleton import JOINT

COCO19 = (
    "neck",
    "nose",
    "mid_hip",
    "left_shoulder",
    "left_elbow",
    "left_wrist",
    "left_hip",
    "left_knee",
    "left_ankle",
    "right_shoulder",
    "right_elbow",
    "right_wrist",
    "right_hip",
    "right_knee",
    "right_ankle",
    "left_eye",
    "left_ear",
    "right_eye",
    "right_ear",
)
"""Joints of the body3DScene files, in their order."""

_SOURCES = {name: (name,) for name in JOINT if name in COCO19} | {
    "pelvis": ("mid_hip",),
    "thorax": ("neck",),
    "spine": ("neck", "mid_hip"),
    "head_top": ("left_eye", "right_eye", "left_ear", "right_ear"),
}
"""The joints of COCO19 whose mean each joint is."""


def joints17(
    joints19: Float[np.ndarray, "T 19 3"],
    valid: Bool[np.ndarray, "T 19"],
) -> tuple[Float[np.ndarray, "T 17 3"], Bool[np.ndarray, "T 17"]]:
    """Return the 17 joints of COCO19, by name, and which are valid.

    A mean (spine, head top) is valid if all of its joints are.
    """
    points = np.empty((len(joints19), len(JOINT), 3))
    joint_valid = np.empty((len(joints19), len(JOINT)), np.bool_)
    for joint, index in JOINT.items():
        sources = [COCO19.index(name) for name in _SOURCES[joint]]
        points[:, index] = joints19[:, sources].mean(1)
        joint_valid[:, index] = valid[:, sources].all(1)
    points = np.where(joint_valid[..., None], points, 0)
    return points.astype(np.float32), joint_valid
