"""Walking, and where the body is: a gait, the path of a walk, and a root that follows the
supporting feet.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from ghpt.data.synthetic.body import FOOT_HEIGHT, SEGMENT, SEGMENTS, Body
from ghpt.skeleton import JOINT, PELVIS

SUPPORT = (
    JOINT["right_ankle"],
    JOINT["right_knee"],
    JOINT["left_ankle"],
    JOINT["left_knee"],
    PELVIS,
)
"""What can carry the body."""
REST = np.array([FOOT_HEIGHT, 0.045, FOOT_HEIGHT, 0.045, 0.05])
"""Its height above the floor when it does, statures; the pelvis' depends on the seat."""
STRIDE = 0.70
"""Length of a stride in statures."""


def _bump(at: float, width: float, phase: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T"]:
    """A periodic bell of height 1."""
    return np.exp((np.cos(2.0 * np.pi * (phase - at)) - 1.0) / (2.0 * np.pi * width) ** 2)


def _step(
    body: Body, own: Float[np.ndarray, " T"]
) -> tuple[Float[np.ndarray, " T"], Float[np.ndarray, " T"]]:
    """Flexion of thigh and shank, ``own`` strides after the heel strike: the ankle stands still for
    0.4 of the cycle, then rises, overtakes the body and comes down one stride ahead.
    """
    own = own % 1.0
    moving = np.clip((own - 0.4) / 0.6, 0.0, 1.0)
    ahead = STRIDE * (0.21 + moving**3 * (10.0 - 15.0 * moving + 6.0 * moving**2) - own)
    lift = 0.055 * _bump(0.63, 0.07, own) + 0.022 * _bump(0.82, 0.08, own)
    below = 0.475 + 0.009 * np.cos(4.0 * np.pi * (own - 0.25)) - lift
    thigh, shank = (
        np.linalg.norm(body.offsets[JOINT[f"right_{joint}"]]) for joint in ("knee", "ankle")
    )
    reach = np.minimum(np.hypot(ahead, below) * body.stature, 0.998 * (thigh + shank))
    knee = np.pi - np.arccos((thigh**2 + shank**2 - reach**2) / (2.0 * thigh * shank))
    hip = np.arccos((thigh**2 + reach**2 - shank**2) / (2.0 * thigh * reach))
    return np.arctan2(ahead, below) + hip, knee


def gait(body: Body, phase: Float[np.ndarray, " T"]) -> Float[np.ndarray, "T S 3"]:
    """Level walking, ``phase`` strides after a right heel strike; arms swing against the legs."""
    angles = np.zeros((len(phase), len(SEGMENTS), 3))
    for side, opposite, own in (("right", "left", phase), ("left", "right", phase + 0.5)):
        angles[:, SEGMENT[f"{side}_thigh"], 0], angles[:, SEGMENT[f"{side}_shank"], 0] = _step(
            body, own
        )
        swing = np.cos(2.0 * np.pi * (own - 0.95))
        angles[:, SEGMENT[f"{opposite}_upper_arm"], 0] = np.deg2rad(16.0) * swing
        angles[:, SEGMENT[f"{opposite}_forearm"], 0] = np.deg2rad(14.0 + 9.0 * swing)
    left = np.cos(2.0 * np.pi * phase)
    angles[:, SEGMENT["pelvis"], 2] = np.deg2rad(4.0) * left
    angles[:, SEGMENT["pelvis"], 1] = np.deg2rad(2.5) * np.sin(2.0 * np.pi * phase)
    angles[:, SEGMENT["lumbar"], 1:] = -angles[:, SEGMENT["pelvis"], 1:]
    angles[:, SEGMENT["thorax"], 2] = np.deg2rad(-5.0) * left
    angles[:, [SEGMENT["lumbar"], SEGMENT["thorax"]], 0] = np.deg2rad(3.0)
    return angles


def blend_gait(
    angles: Float[np.ndarray, "T S 3"],
    gait: Float[np.ndarray, "T S 3"],
    walking: Float[np.ndarray, " T"],
) -> Float[np.ndarray, "T S 3"]:
    """Legs and pelvis change over to the gait; the arms swing as far as their posture leaves them
    free.
    """
    on = walking[:, None, None]
    legs = [SEGMENT[f"{side}_{part}"] for side in ("right", "left") for part in ("thigh", "shank")]
    flexed = angles[:, SEGMENT["right_thigh"], 0] + angles[:, SEGMENT["left_thigh"], 0]
    straight = np.clip(1.0 - flexed / 2.0, 0.0, 1.0)[:, None, None]
    blended = angles + on * np.where(np.isin(np.arange(len(SEGMENTS)), legs)[:, None], 0.0, gait)
    blended[:, legs] = (1.0 - on) * angles[:, legs] + on * (
        gait[:, legs] + 0.15 * straight * angles[:, legs]
    )
    trunk = [SEGMENT[name] for name in ("pelvis", "lumbar", "thorax")]
    blended[:, trunk, 0] -= (
        walking[:, None] * 0.8 * np.maximum(angles[:, trunk, 0] - np.deg2rad(5.0), 0.0)
    )
    for side in ("right", "left"):
        hanging = np.exp(-((angles[:, SEGMENT[f"{side}_forearm"], 0] / np.deg2rad(45.0)) ** 2))
        for part in ("upper_arm", "forearm"):
            index = SEGMENT[f"{side}_{part}"]
            blended[:, index] -= (on[..., 0] * (1.0 - hanging[:, None])) * gait[:, index]
    return blended


def walk_path(
    distance: Float[np.ndarray, " T"], rng: np.random.Generator
) -> tuple[Float[np.ndarray, "T 2"], Float[np.ndarray, " T"]]:
    """Where a walk of ``distance`` mm leads on a slowly turning, off-centre ellipse, and the
    heading along it.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, 721)
    axes = rng.uniform([1000.0, 650.0], [1400.0, 1000.0])
    curve = axes * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    length = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))]
    start = rng.uniform(0.0, length[-1])
    clockwise = rng.choice([-1.0, 1.0])
    laps, along = np.divmod(start + distance, length[-1])
    at = np.interp(along, length, angle)
    precess = rng.uniform(0.0, 2.0 * np.pi) + 0.35 * (laps + at / (2.0 * np.pi))
    local = np.stack([axes[0] * np.cos(at), clockwise * axes[1] * np.sin(at)])
    tangent = np.arctan2(clockwise * axes[1] * np.cos(at), -axes[0] * np.sin(at))
    path = np.stack(
        [
            np.cos(precess) * local[0] - np.sin(precess) * local[1],
            np.sin(precess) * local[0] + np.cos(precess) * local[1],
        ]
    ).T
    return path + rng.normal(0.0, 120.0, 2), np.unwrap(tangent + precess)


def _carried(
    joints: Float[np.ndarray, "T J 3"], rest: Float[np.ndarray, "T P"]
) -> Float[np.ndarray, "T 2"]:
    """How far the root moves over the floor in each frame if what carries the body stays where it
    is.
    """
    height = joints[:, SUPPORT, 2] - rest
    weight = np.exp(-(height - height.min(axis=1, keepdims=True)) / 12.0)
    weight /= weight.sum(axis=1, keepdims=True)
    points = joints[:, SUPPORT, :2]
    before = np.concatenate([points[:1], points[:-1]])
    return -(weight[..., None] * (points - before)).sum(axis=1)


def root_motion(
    joints: Float[np.ndarray, "T J 3"],
    path: Float[np.ndarray, "T 2"],
    rest: Float[np.ndarray, "T P"],
    rate_hz: float,
) -> Float[np.ndarray, "T 3"]:
    """Stand on the lowest support, and follow the feet from moment to moment but the path in the
    long run.
    """
    height = joints[:, SUPPORT, 2] - rest
    lowest = height.min(axis=1, keepdims=True)
    up = 8.0 * np.log(np.exp(-(height - lowest) / 8.0).sum(axis=1)) - lowest[:, 0]
    carried = np.cumsum(_carried(joints, rest), axis=0)
    drift = gaussian_filter1d(carried - path, 1.2 * rate_hz, axis=0, mode="nearest")
    return np.column_stack([carried - drift, up])
