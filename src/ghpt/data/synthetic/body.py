"""A kinematic body of 17 joints: its size, forward kinematics, and what its volume hides."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ghpt.skeleton import JOINT, JOINTS, PELVIS, THORAX


class Segment(IntEnum):
    """The rigid segments, parents first: the order of every array of joint angles."""

    PELVIS = 0
    LUMBAR = 1
    THORAX = 2
    NECK = 3
    RIGHT_CLAVICLE = 4
    RIGHT_UPPER_ARM = 5
    RIGHT_FOREARM = 6
    LEFT_CLAVICLE = 7
    LEFT_UPPER_ARM = 8
    LEFT_FOREARM = 9
    RIGHT_THIGH = 10
    RIGHT_SHANK = 11
    LEFT_THIGH = 12
    LEFT_SHANK = 13


SEGMENTS = tuple(Segment)


@dataclass(frozen=True)
class Side:
    """The segments of one side of the body."""

    clavicle: Segment
    upper_arm: Segment
    forearm: Segment
    thigh: Segment
    shank: Segment


RIGHT = Side(
    clavicle=Segment.RIGHT_CLAVICLE,
    upper_arm=Segment.RIGHT_UPPER_ARM,
    forearm=Segment.RIGHT_FOREARM,
    thigh=Segment.RIGHT_THIGH,
    shank=Segment.RIGHT_SHANK,
)
LEFT = Side(
    clavicle=Segment.LEFT_CLAVICLE,
    upper_arm=Segment.LEFT_UPPER_ARM,
    forearm=Segment.LEFT_FOREARM,
    thigh=Segment.LEFT_THIGH,
    shank=Segment.LEFT_SHANK,
)

_PARENTS = {
    Segment.LUMBAR: Segment.PELVIS,
    Segment.THORAX: Segment.LUMBAR,
    Segment.NECK: Segment.THORAX,
    Segment.RIGHT_CLAVICLE: Segment.THORAX,
    Segment.RIGHT_UPPER_ARM: Segment.RIGHT_CLAVICLE,
    Segment.RIGHT_FOREARM: Segment.RIGHT_UPPER_ARM,
    Segment.LEFT_CLAVICLE: Segment.THORAX,
    Segment.LEFT_UPPER_ARM: Segment.LEFT_CLAVICLE,
    Segment.LEFT_FOREARM: Segment.LEFT_UPPER_ARM,
    Segment.RIGHT_THIGH: Segment.PELVIS,
    Segment.RIGHT_SHANK: Segment.RIGHT_THIGH,
    Segment.LEFT_THIGH: Segment.PELVIS,
    Segment.LEFT_SHANK: Segment.LEFT_THIGH,
}

_JOINT_TREE: dict[str, tuple[str, Segment]] = {
    "right_hip": ("pelvis", Segment.PELVIS),
    "left_hip": ("pelvis", Segment.PELVIS),
    "right_knee": ("right_hip", Segment.RIGHT_THIGH),
    "left_knee": ("left_hip", Segment.LEFT_THIGH),
    "right_ankle": ("right_knee", Segment.RIGHT_SHANK),
    "left_ankle": ("left_knee", Segment.LEFT_SHANK),
    "spine": ("pelvis", Segment.LUMBAR),
    "thorax": ("spine", Segment.THORAX),
    "nose": ("thorax", Segment.NECK),
    "head_top": ("thorax", Segment.NECK),
    "right_shoulder": ("thorax", Segment.RIGHT_CLAVICLE),
    "left_shoulder": ("thorax", Segment.LEFT_CLAVICLE),
    "right_elbow": ("right_shoulder", Segment.RIGHT_UPPER_ARM),
    "left_elbow": ("left_shoulder", Segment.LEFT_UPPER_ARM),
    "right_wrist": ("right_elbow", Segment.RIGHT_FOREARM),
    "left_wrist": ("left_elbow", Segment.LEFT_FOREARM),
}
"""For each joint the joint that it hangs on, and the segment that carries it."""

_PROPORTIONS = {
    "hip": (0.0, 0.074, -0.005),
    "knee": (0.0, 0.0, -0.245),
    "ankle": (0.0, 0.0, -0.246),
    "spine": (-0.012, 0.0, 0.138),
    "thorax": (0.012, 0.0, 0.150),
    "nose": (0.042, 0.0, 0.062),
    "head_top": (0.012, 0.0, 0.135),
    "shoulder": (0.0, 0.100, -0.028),
    "elbow": (0.0, 0.0, -0.172),
    "wrist": (0.0, 0.0, -0.146),
}
"""Joint relative to the joint it hangs on, standing with hanging arms: forward, left, up, in
statures. Thigh, shank, forearm and the heights of hip, shoulder and chin: Drillis and Contini 1966,
as printed in Winter, Biomechanics and Motor Control of Human Movement, 2009, fig. 4.1. Its upper
arm (0.186) starts at the acromion and its widths end at the skin, so upper arm, shoulders and hips
are shortened to the joint centres.
"""

FOOT_HEIGHT = 0.039
"""Height of the ankle above the floor in statures (same source)."""


@dataclass(frozen=True)
class Capsule:
    """A part of the body's volume: what is within ``radius`` statures of a line of two joints."""

    start: int
    end: int
    radius: float


def _capsule(start: str, end: str, radius: float) -> Capsule:
    return Capsule(JOINT[start], JOINT[end], radius)


CAPSULES = (
    _capsule("right_hip", "right_knee", 0.042),
    _capsule("left_hip", "left_knee", 0.042),
    _capsule("right_knee", "right_ankle", 0.029),
    _capsule("left_knee", "left_ankle", 0.029),
    _capsule("right_shoulder", "right_elbow", 0.027),
    _capsule("left_shoulder", "left_elbow", 0.027),
    _capsule("right_elbow", "right_wrist", 0.021),
    _capsule("left_elbow", "left_wrist", 0.021),
    _capsule("right_hip", "right_shoulder", 0.055),
    _capsule("left_hip", "left_shoulder", 0.055),
    _capsule("pelvis", "thorax", 0.062),
    _capsule("thorax", "head_top", 0.048),
)
"""The volume of the body."""

_LEG_BONES = (
    (JOINT["right_ankle"], JOINT["right_knee"]),
    (JOINT["left_ankle"], JOINT["left_knee"]),
    (JOINT["right_knee"], JOINT["right_hip"]),
    (JOINT["left_knee"], JOINT["left_hip"]),
)
_LEG_STATURES = 0.491
"""Length of a leg from hip to ankle in statures, of ``_PROPORTIONS``."""


@dataclass(frozen=True)
class Body:
    """One person's size."""

    stature: float
    """mm."""
    offsets: Float[np.ndarray, "J 3"]
    """Joint relative to the joint it hangs on, in the frame of its segment (x forward, y left, z
    up), mm.
    """


def random_body(rng: np.random.Generator) -> Body:
    """Draw a person from adults: stature 1.73 +- 0.08 m, proportions +- 3 %.

    The sides differ by about 1 %.
    """
    stature = float(np.clip(rng.normal(1730.0, 80.0), 1530.0, 1930.0))
    factors = np.exp(rng.normal(0.0, 0.03, len(_PROPORTIONS)))
    proportion = dict(zip(_PROPORTIONS, factors, strict=True))
    asymmetry = np.exp(rng.normal(0.0, 0.008, len(JOINTS)))
    offsets = np.zeros((len(JOINTS), 3))
    for joint in _JOINT_TREE:
        kind = joint.removeprefix("right_").removeprefix("left_")
        offset = np.array(_PROPORTIONS[kind]) * stature * proportion[kind]
        if kind != joint:
            offset = offset * asymmetry[JOINT[joint]]
        sideways = -1.0 if joint.startswith("right") else 1.0
        offsets[JOINT[joint]] = offset * np.array([1.0, sideways, 1.0])
    return Body(stature, offsets)


def pose(body: Body, angles: Float[np.ndarray, "T S 3"]) -> Float[np.ndarray, "T J 3"]:
    """Return the joints of joint angles, in mm with the pelvis at the origin, z up.

    ``angles`` are flexion, abduction (of the trunk: bending to the left) and inward rotation (of
    the trunk: rotation to the left) of each of ``SEGMENTS`` in its parent's frame, radians; flexion
    of the trunk is forward, of the shank backward. The pelvis' rotation is the heading. The same
    angles on both sides are mirror images.
    """
    orientation = _segment_orientations(angles)
    joints = np.zeros((len(angles), len(JOINTS), 3))
    for joint, (parent, segment) in _JOINT_TREE.items():
        offset = orientation[:, segment] @ body.offsets[JOINT[joint]]
        joints[:, JOINT[joint]] = joints[:, JOINT[parent]] + offset
    return joints


def _segment_orientations(angles: Float[np.ndarray, "T S 3"]) -> Float[np.ndarray, "T S 3 3"]:
    """Return the rotation of each segment's frame to the world."""
    signed = angles * _SIGNS
    local = Rotation.from_euler("YXZ", signed.reshape(-1, 3)).as_matrix()
    orientation = local.reshape(*angles.shape, 3)
    heading_first = signed[:, Segment.PELVIS][:, [2, 0, 1]]
    pelvis = Rotation.from_euler("ZYX", heading_first)
    orientation[:, Segment.PELVIS] = pelvis.as_matrix()
    for segment, parent in _PARENTS.items():
        orientation[:, segment] = orientation[:, parent] @ orientation[:, segment]
    return orientation


def stature(points: Float[np.ndarray, "T J 3"]) -> float:
    """Return the person's stature (mm), from the length of the legs."""
    bones = [points[:, a] - points[:, b] for a, b in _LEG_BONES]
    lengths = [np.linalg.norm(bone, axis=-1) for bone in bones]
    both_legs = np.median(np.sum(lengths, axis=0))
    return float(both_legs / 2.0 / _LEG_STATURES)


def trunk_frame(points: Float[np.ndarray, "T J 3"]) -> Float[np.ndarray, "T 3 3"]:
    """Return the trunk's axes in the world as columns: forward, left and up."""
    up = _normalise(points[:, THORAX] - points[:, PELVIS])
    across = points[:, JOINT["left_hip"]] - points[:, JOINT["right_hip"]]
    forward = _normalise(np.cross(across, up))
    left = np.cross(up, forward)
    return np.stack([forward, left, up], axis=-1)


def _normalise(vector: Float[np.ndarray, "*T 3"]) -> Float[np.ndarray, "*T 3"]:
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    return vector / length.clip(min=1e-9)


def occlusion(in_camera: Float[np.ndarray, "T J 3"], stature: float) -> Float[np.ndarray, "T J"]:
    """Return how far the body hides each joint from a camera, 0 to 1.

    A joint is hidden where its image lies within a capsule that is nearer. Joints are in the
    camera's frame, mm.
    """
    start = [capsule.start for capsule in CAPSULES]
    end = [capsule.end for capsule in CAPSULES]
    radii = np.array([capsule.radius * stature for capsule in CAPSULES], dtype=np.float32)
    x, y, depth = np.moveaxis(in_camera, -1, 0)
    depth = depth.clip(min=1.0)
    x = x / depth
    y = y / depth
    # one by one: reductions over a last axis of two numbers would take most of the time
    start_depth = depth[:, None, start]
    axis_x = x[:, None, end] - x[:, None, start]
    axis_y = y[:, None, end] - y[:, None, start]
    axis_depth = depth[:, None, end] - start_depth
    offset_x = x[..., None] - x[:, None, start]
    offset_y = y[..., None] - y[:, None, start]
    square_length = (axis_x**2 + axis_y**2).clip(min=1e-12)
    position = (offset_x * axis_x + offset_y * axis_y) / square_length
    position = position.clip(0.0, 1.0)
    axis_point_depth = start_depth + position * axis_depth
    apart_x = offset_x - position * axis_x
    apart_y = offset_y - position * axis_y
    distance = np.sqrt(apart_x**2 + apart_y**2) * axis_point_depth
    inside = (1.15 - distance / radii) * np.float32(2.5)
    farther = depth[..., None] - axis_point_depth - np.float32(0.5) * radii
    behind = farther * np.float32(50.0 / stature)
    hidden = inside.clip(0.0, 1.0) * behind.clip(0.0, 1.0)
    joint = np.arange(len(JOINTS))[:, None]
    own = (joint == start) | (joint == end)
    return np.where(own, np.float32(0.0), hidden).max(axis=-1)


def _segment_signs() -> Float[np.ndarray, "S 3"]:
    # About y (left), x (forward), z (up): a positive rotation about y leans the trunk forward and
    # swings a hanging limb backward; a positive rotation about x tips the trunk right and a hanging
    # limb to the left.
    signs = np.tile([-1.0, 1.0, -1.0], (len(SEGMENTS), 1))
    for segment in (RIGHT.clavicle, RIGHT.upper_arm, RIGHT.forearm, RIGHT.thigh, RIGHT.shank):
        signs[segment] *= [1.0, -1.0, -1.0]
    for segment in (RIGHT.shank, LEFT.shank):
        signs[segment, 0] = 1.0
    for segment in (Segment.PELVIS, Segment.LUMBAR, Segment.THORAX, Segment.NECK):
        signs[segment] = [1.0, -1.0, 1.0]
    return signs


_SIGNS = _segment_signs()
