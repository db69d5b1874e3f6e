"""Walking, and where the body is: a gait, a path, and a root that follows the supporting feet."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from ghpt.data.synthetic.body import (
    FOOT_HEIGHT,
    LEFT,
    RIGHT,
    SEGMENTS,
    Body,
    Segment,
    Side,
)
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

_CYCLE = 2.0 * np.pi


def minimum_jerk(progress: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T"]:
    """Return the share of the path at a share of the time, both 0 to 1, that has least jerk."""
    return progress**3 * (10.0 - 15.0 * progress + 6.0 * progress**2)


def _bell(
    centre: float,
    width: float,
    phase: Float[np.ndarray, " T"],
) -> Float[np.ndarray, " T"]:
    """Return a periodic bell of height 1."""
    cosine = np.cos(2.0 * np.pi * (phase - centre))
    return np.exp((cosine - 1.0) / (2.0 * np.pi * width) ** 2)


def _leg_flexion(
    body: Body,
    phase: Float[np.ndarray, " T"],
) -> tuple[Float[np.ndarray, " T"], Float[np.ndarray, " T"]]:
    """Return the flexion of thigh and shank, ``phase`` strides after the heel strike.

    The ankle stands still for 0.4 of the cycle, then rises, overtakes the body and comes down one
    stride ahead.
    """
    phase = phase % 1.0
    swing = np.clip((phase - 0.4) / 0.6, 0.0, 1.0)
    ahead = STRIDE * (0.21 + minimum_jerk(swing) - phase)
    lift = 0.055 * _bell(0.63, 0.07, phase) + 0.022 * _bell(0.82, 0.08, phase)
    hip_height = 0.475 + 0.009 * np.cos(4.0 * np.pi * (phase - 0.25))
    below = hip_height - lift
    thigh = np.linalg.norm(body.offsets[JOINT["right_knee"]])
    shank = np.linalg.norm(body.offsets[JOINT["right_ankle"]])
    longest = 0.998 * (thigh + shank)
    reach = np.minimum(np.hypot(ahead, below) * body.stature, longest)
    # the law of cosines in the triangle of hip, knee and ankle
    knee_cosine = (thigh**2 + shank**2 - reach**2) / (2.0 * thigh * shank)
    hip_cosine = (thigh**2 + reach**2 - shank**2) / (2.0 * thigh * reach)
    knee = np.pi - np.arccos(knee_cosine)
    hip = np.arctan2(ahead, below) + np.arccos(hip_cosine)
    return hip, knee


def gait(body: Body, phase: Float[np.ndarray, " T"]) -> Float[np.ndarray, "T S 3"]:
    """Return the angles of level walking, ``phase`` strides after a right heel strike.

    The arms swing against the legs.
    """
    angles = np.zeros((len(phase), len(SEGMENTS), 3))
    _set_limbs(angles, RIGHT, LEFT, body, phase)
    _set_limbs(angles, LEFT, RIGHT, body, phase + 0.5)
    cosine = np.cos(2.0 * np.pi * phase)
    angles[:, Segment.PELVIS, 2] = np.deg2rad(4.0) * cosine
    angles[:, Segment.PELVIS, 1] = np.deg2rad(2.5) * np.sin(2.0 * np.pi * phase)
    angles[:, Segment.LUMBAR, 1:] = -angles[:, Segment.PELVIS, 1:]
    angles[:, Segment.THORAX, 2] = np.deg2rad(-5.0) * cosine
    angles[:, Segment.LUMBAR, 0] = np.deg2rad(3.0)
    angles[:, Segment.THORAX, 0] = np.deg2rad(3.0)
    return angles


def _set_limbs(
    angles: Float[np.ndarray, "T S 3"],
    side: Side,
    opposite: Side,
    body: Body,
    phase: Float[np.ndarray, " T"],
) -> None:
    """Set the leg of one side and the arm of the other, ``phase`` strides after the heel strike."""
    thigh, shank = _leg_flexion(body, phase)
    angles[:, side.thigh, 0] = thigh
    angles[:, side.shank, 0] = shank
    swing = np.cos(2.0 * np.pi * (phase - 0.95))
    angles[:, opposite.upper_arm, 0] = np.deg2rad(16.0) * swing
    angles[:, opposite.forearm, 0] = np.deg2rad(14.0 + 9.0 * swing)


def blend_gait(
    angles: Float[np.ndarray, "T S 3"],
    gait: Float[np.ndarray, "T S 3"],
    walking: Float[np.ndarray, " T"],
) -> Float[np.ndarray, "T S 3"]:
    """Return the angles of a body that walks where ``walking`` is 1.

    Legs and pelvis change over to the gait; the arms swing as far as their posture leaves them
    free.
    """
    share = walking[:, None, None]
    legs = [RIGHT.thigh, RIGHT.shank, LEFT.thigh, LEFT.shank]
    gait_of_others = gait.copy()
    gait_of_others[:, legs] = 0.0
    blended = angles + share * gait_of_others
    flexion = angles[:, RIGHT.thigh, 0] + angles[:, LEFT.thigh, 0]
    straight = np.clip(1.0 - flexion / 2.0, 0.0, 1.0)[:, None, None]
    own_legs = angles[:, legs]
    gait_legs = gait[:, legs] + 0.15 * straight * own_legs
    blended[:, legs] = (1.0 - share) * own_legs + share * gait_legs
    trunk = [Segment.PELVIS, Segment.LUMBAR, Segment.THORAX]
    lean = np.maximum(angles[:, trunk, 0] - np.deg2rad(5.0), 0.0)
    blended[:, trunk, 0] -= walking[:, None] * 0.8 * lean
    for side in (RIGHT, LEFT):
        bent = angles[:, side.forearm, 0] / np.deg2rad(45.0)
        hanging = np.exp(-(bent**2))
        bound = share[..., 0] * (1.0 - hanging[:, None])
        for segment in (side.upper_arm, side.forearm):
            blended[:, segment] -= bound * gait[:, segment]
    return blended


def walk_path(
    distance: Float[np.ndarray, " T"],
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "T 2"], Float[np.ndarray, " T"]]:
    """Return where a walk of ``distance`` mm leads, and the heading along it.

    It follows a slowly rotating, off-centre ellipse.
    """
    axes = rng.uniform([1000.0, 650.0], [1400.0, 1000.0])
    angle, length = _ellipse_lengths(axes)
    start = rng.uniform(0.0, length[-1])
    clockwise = rng.choice([-1.0, 1.0])
    laps, lap_distance = np.divmod(start + distance, length[-1])
    position = np.interp(lap_distance, length, angle)
    precession = rng.uniform(0.0, _CYCLE) + 0.35 * (laps + position / _CYCLE)
    width, height = axes
    x = width * np.cos(position)
    y = clockwise * height * np.sin(position)
    tangent = np.arctan2(clockwise * height * np.cos(position), -width * np.sin(position))
    rotated_x = np.cos(precession) * x - np.sin(precession) * y
    rotated_y = np.sin(precession) * x + np.cos(precession) * y
    path = np.stack([rotated_x, rotated_y]).T
    centre = rng.normal(0.0, 120.0, 2)
    return path + centre, np.unwrap(tangent + precession)


def _ellipse_lengths(
    axes: Float[np.ndarray, " 2"],
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Return angles once around an ellipse, and the length of its arc up to each."""
    angle = np.linspace(0.0, _CYCLE, 721)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    chords = np.diff(axes * circle, axis=0)
    lengths = np.cumsum(np.linalg.norm(chords, axis=1))
    return angle, np.r_[0.0, lengths]


def _support_motion(
    joints: Float[np.ndarray, "T J 3"],
    rest: Float[np.ndarray, "T P"],
) -> Float[np.ndarray, "T 2"]:
    """Return the root's motion over the floor in each frame if what carries the body stands."""
    height = joints[:, SUPPORT, 2] - rest
    lowest = height.min(axis=1, keepdims=True)
    weight = np.exp(-(height - lowest) / 12.0)
    weight /= weight.sum(axis=1, keepdims=True)
    points = joints[:, SUPPORT, :2]
    previous = np.concatenate([points[:1], points[:-1]])
    motion = weight[..., None] * (points - previous)
    return -motion.sum(axis=1)


def root_motion(
    joints: Float[np.ndarray, "T J 3"],
    path: Float[np.ndarray, "T 2"],
    rest: Float[np.ndarray, "T P"],
    rate_hz: float,
) -> Float[np.ndarray, "T 3"]:
    """Return where the root is: the body stands on its lowest support.

    Over the floor it follows the feet from moment to moment, but the path in the long run.
    """
    height = joints[:, SUPPORT, 2] - rest
    lowest = height.min(axis=1, keepdims=True)
    softness = np.exp(-(height - lowest) / 8.0).sum(axis=1)
    up = 8.0 * np.log(softness) - lowest[:, 0]
    carried = np.cumsum(_support_motion(joints, rest), axis=0)
    drift = gaussian_filter1d(carried - path, 1.2 * rate_hz, axis=0, mode="nearest")
    return np.column_stack([carried - drift, up])
