"""A kinematic body of 17 joints: segment lengths, forward kinematics, and the volume that hides
joints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ghpt.skeleton import JOINT, JOINTS, PELVIS, THORAX

SEGMENTS = (
    "pelvis",
    "lumbar",
    "thorax",
    "neck",
    "right_clavicle",
    "right_upper_arm",
    "right_forearm",
    "left_clavicle",
    "left_upper_arm",
    "left_forearm",
    "right_thigh",
    "right_shank",
    "left_thigh",
    "left_shank",
)
"""The rigid parts, parents first: the order of every array of joint angles."""

SEGMENT = {name: index for index, name in enumerate(SEGMENTS)}

_PARENTS = {
    "lumbar": "pelvis",
    "thorax": "lumbar",
    "neck": "thorax",
    "right_clavicle": "thorax",
    "right_upper_arm": "right_clavicle",
    "right_forearm": "right_upper_arm",
    "left_clavicle": "thorax",
    "left_upper_arm": "left_clavicle",
    "left_forearm": "left_upper_arm",
    "right_thigh": "pelvis",
    "right_shank": "right_thigh",
    "left_thigh": "pelvis",
    "left_shank": "left_thigh",
}

_JOINT_TREE = {
    "right_hip": ("pelvis", "pelvis"),
    "left_hip": ("pelvis", "pelvis"),
    "right_knee": ("right_hip", "right_thigh"),
    "left_knee": ("left_hip", "left_thigh"),
    "right_ankle": ("right_knee", "right_shank"),
    "left_ankle": ("left_knee", "left_shank"),
    "spine": ("pelvis", "lumbar"),
    "thorax": ("spine", "thorax"),
    "nose": ("thorax", "neck"),
    "head_top": ("thorax", "neck"),
    "right_shoulder": ("thorax", "right_clavicle"),
    "left_shoulder": ("thorax", "left_clavicle"),
    "right_elbow": ("right_shoulder", "right_upper_arm"),
    "left_elbow": ("left_shoulder", "left_upper_arm"),
    "right_wrist": ("right_elbow", "right_forearm"),
    "left_wrist": ("left_elbow", "left_forearm"),
}
"""Joint -> (joint that it hangs on, segment that carries it)."""

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

CAPSULES = tuple(
    (JOINT[a], JOINT[b], radius)
    for a, b, radius in (
        ("right_hip", "right_knee", 0.042),
        ("left_hip", "left_knee", 0.042),
        ("right_knee", "right_ankle", 0.029),
        ("left_knee", "left_ankle", 0.029),
        ("right_shoulder", "right_elbow", 0.027),
        ("left_shoulder", "left_elbow", 0.027),
        ("right_elbow", "right_wrist", 0.021),
        ("left_elbow", "left_wrist", 0.021),
        ("right_hip", "right_shoulder", 0.055),
        ("left_hip", "left_shoulder", 0.055),
        ("pelvis", "thorax", 0.062),
        ("thorax", "head_top", 0.048),
    )
)
"""The volume of the body: segments between two joints, with their radius in statures."""

_LEGS = tuple(
    (JOINT[f"{side}_{lower}"], JOINT[f"{side}_{upper}"])
    for lower, upper in (("ankle", "knee"), ("knee", "hip"))
    for side in ("right", "left")
)


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
    """A person drawn from adults: stature 1.73 +- 0.08 m, proportions +- 3 %, sides that differ by
    about 1 %.
    """
    stature = float(np.clip(rng.normal(1730.0, 80.0), 1530.0, 1930.0))
    proportion = dict(
        zip(_PROPORTIONS, np.exp(rng.normal(0.0, 0.03, len(_PROPORTIONS))), strict=True)
    )
    side = np.exp(rng.normal(0.0, 0.008, len(JOINTS)))
    offsets = np.zeros((len(JOINTS), 3))
    for joint in _JOINT_TREE:
        kind = joint.removeprefix("right_").removeprefix("left_")
        offset = np.array(_PROPORTIONS[kind]) * stature * proportion[kind]
        if kind != joint:
            offset = offset * side[JOINT[joint]]
        offsets[JOINT[joint]] = offset * np.array(
            [1.0, -1.0 if joint.startswith("right") else 1.0, 1.0]
        )
    return Body(stature, offsets)


def pose(body: Body, angles: Float[np.ndarray, "T S 3"]) -> Float[np.ndarray, "T J 3"]:
    """Forward kinematics: joints in mm with the pelvis at the origin, z up.

    ``angles`` are flexion, abduction (of the trunk: bending to the left) and inward rotation (of
    the trunk: turning left) of each of ``SEGMENTS`` in its parent's frame, radians; flexion of the
    trunk is forward, of the shank backward. The pelvis' turn is the heading. The same angles on
    both sides are mirror images.
    """
    local = Rotation.from_euler("YXZ", (angles * _SIGNS).reshape(-1, 3)).as_matrix()
    world = local.reshape(*angles.shape, 3)
    heading_first = (angles[:, 0] * _SIGNS[0])[:, [2, 0, 1]]
    world[:, 0] = Rotation.from_euler("ZYX", heading_first).as_matrix()
    for name, parent in _PARENTS.items():
        world[:, SEGMENT[name]] = world[:, SEGMENT[parent]] @ world[:, SEGMENT[name]]
    joints = np.zeros((len(angles), len(JOINTS), 3))
    for joint, (base, segment) in _JOINT_TREE.items():
        joints[:, JOINT[joint]] = (
            joints[:, JOINT[base]] + world[:, SEGMENT[segment]] @ body.offsets[JOINT[joint]]
        )
    return joints


def stature(points: Float[np.ndarray, "T J 3"]) -> float:
    """The person's stature (mm) from the legs, which are 0.491 of it of ``_PROPORTIONS``."""
    length = [np.linalg.norm(points[:, a] - points[:, b], axis=-1) for a, b in _LEGS]
    return float(np.median(np.sum(length, axis=0)) / 2.0 / 0.491)


def trunk_frame(points: Float[np.ndarray, "T J 3"]) -> Float[np.ndarray, "T 3 3"]:
    """Columns: forward, left and up of the trunk, in the world."""
    up = points[:, THORAX] - points[:, PELVIS]
    up = up / np.linalg.norm(up, axis=-1, keepdims=True).clip(min=1e-9)
    across = points[:, JOINT["left_hip"]] - points[:, JOINT["right_hip"]]
    forward = np.cross(across, up)
    forward /= np.linalg.norm(forward, axis=-1, keepdims=True).clip(min=1e-9)
    return np.stack([forward, np.cross(up, forward), up], axis=-1)


def occlusion(in_camera: Float[np.ndarray, "T J 3"], person: float) -> Float[np.ndarray, "T J"]:
    """How far the body hides each joint from a camera, 0 to 1: its image lies within a capsule that
    is nearer.
    """
    ends = np.array([capsule[:2] for capsule in CAPSULES])
    radii = np.array([capsule[2] * person for capsule in CAPSULES], dtype=np.float32)
    x, y, depth = np.moveaxis(in_camera, -1, 0)
    depth = depth.clip(min=1.0)
    x = x / depth
    y = y / depth
    (ax, bx), (ay, by), (near_a, near_b) = (
        (v[:, ends[:, 0]], v[:, ends[:, 1]]) for v in (x, y, depth)
    )
    # one by one: reductions over a last axis of two numbers would take most of the time
    axis_x, axis_y, axis_depth = (v[:, None] for v in (bx - ax, by - ay, near_b - near_a))
    off_x = x[..., None] - ax[:, None]
    off_y = y[..., None] - ay[:, None]
    along = (off_x * axis_x + off_y * axis_y) / (axis_x**2 + axis_y**2).clip(min=1e-12)
    along = along.clip(0.0, 1.0)
    nearest = near_a[:, None] + along * axis_depth
    distance = np.sqrt((off_x - along * axis_x) ** 2 + (off_y - along * axis_y) ** 2) * nearest
    inside = ((1.15 - distance / radii) * np.float32(2.5)).clip(0.0, 1.0)
    behind = (
        (depth[..., None] - nearest - np.float32(0.5) * radii) * np.float32(50.0 / person)
    ).clip(0.0, 1.0)
    own = (ends == np.arange(len(JOINTS))[:, None, None]).any(axis=-1)
    return np.where(own, np.float32(0.0), inside * behind).max(axis=-1)


def _segment_signs() -> Float[np.ndarray, "S 3"]:
    # About y (left), x (forward), z (up): a positive turn about y leans the trunk forward and
    # swings a hanging limb backward; a positive turn about x tips the trunk right and a hanging
    # limb to the left.
    signs = np.tile([-1.0, 1.0, -1.0], (len(SEGMENTS), 1))
    for name in SEGMENTS:
        row = signs[SEGMENT[name]]
        if name.startswith("right"):
            row *= [1.0, -1.0, -1.0]
        if name.endswith("shank"):
            row[0] = 1.0
        if name in ("pelvis", "lumbar", "thorax", "neck"):
            row[:] = [1.0, -1.0, 1.0]
    return signs


_SIGNS = _segment_signs()
