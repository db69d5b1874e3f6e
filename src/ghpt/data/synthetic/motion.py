"""Smooth human motion by action: joint angles that move between postures.

World frame: mm, z up, floor at z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from ghpt.data.synthetic.actions import ActionSpec, Postures, action_spec
from ghpt.data.synthetic.body import LEFT, RIGHT, SEGMENTS, Body, Segment, Side, pose
from ghpt.data.synthetic.gait import (
    REST,
    STRIDE,
    blend_gait,
    gait,
    minimum_jerk,
    root_motion,
    walk_path,
)

_LEGS_SPREAD = np.array([3.0, 2.0, 3.0, 4.0, 3.0, 2.0, 3.0, 4.0, 2.0, 3.0, 3.0, 0.5])
"""Deviations of a posture of the legs, in the units of ``ActionSpec.legs``."""
_ARM_SPREAD = np.array([8.0, 6.0, 9.0, 9.0])
"""Deviations of a posture of an arm, degrees."""
_HINGES = [RIGHT.forearm, RIGHT.shank, LEFT.forearm, LEFT.shank]
"""Segments that bend one way: elbows and knees."""


def synthesize_motion(
    body: Body,
    action: str,
    frames: int,
    rate_hz: float,
    rng: np.random.Generator,
    left_handed: bool = False,
) -> Float[np.ndarray, "T J 3"]:
    """Return a take of one action of ``action_names``: joints in mm, z up, feet on z = 0.

    It starts near the world's origin.
    """
    spec = action_spec(action)
    time = np.arange(frames) / rate_hz
    legs, seat = _draw_legs(spec, time, rng)
    angles = _draw_restlessness(spec, frames, rate_hz, rng)
    _add_legs(angles, legs)
    preferred = LEFT if left_handed else RIGHT
    for side in (RIGHT, LEFT):
        postures = spec.preferred_arm if side is preferred else spec.other_arm
        _add_arm(angles, side, _draw_arm(spec, postures, time, rng))
    _add_trunk(angles, _draw_trunk(spec, time, rng))
    turn = _draw_turn(spec, time, rng)
    walk = _draw_walk(spec, time, rate_hz, rng)
    path = walk.path
    if spec.walk == 0:
        path = 0.3 * path  # who does not walk stands near the middle
    else:
        phase = rng.uniform() + walk.strides / (STRIDE * body.stature)
        angles = blend_gait(angles, gait(body, phase), walk.swing)
    # Who walks faces where the path leads.
    angles[:, Segment.PELVIS, 2] += walk.heading + (1.0 - walk.walking) * turn
    joints = pose(body, _limit_hinges(angles))
    rest = np.tile(REST, (frames, 1))
    rest[:, -1] = seat
    root = root_motion(joints, path, rest * body.stature, rate_hz)
    return joints + root[:, None]


def keyframes(
    rng: np.random.Generator,
    time: Float[np.ndarray, " T"],
    postures: Postures,
    spread: Float[np.ndarray, " D"] | float,
    hold: float,
    reach: float,
) -> Float[np.ndarray, "T D"]:
    """Return angles that rest in random postures and move between them.

    A posture, with normal deviations of ``spread``, is held for ``hold`` s on average; the next is
    reached along a minimum-jerk curve in ``reach`` s on average.
    """
    count = int(time[-1] / (0.35 * hold + 0.7 * reach)) + 2
    probability = postures.weights / np.sum(postures.weights)
    choices, dimensions = postures.angles.shape
    chosen = rng.choice(choices, count, p=probability)
    deviation = rng.normal(0.0, 1.0, (count, dimensions)) * spread
    target = postures.angles[chosen] + deviation
    duration = reach * rng.uniform(0.7, 1.6, count)
    rest = hold * (0.35 + rng.exponential(0.65, count))
    start = np.cumsum(rest + np.r_[0.0, duration[:-1]])
    index = np.searchsorted(start, time, side="right") - 1
    progress = np.clip((time - start[index]) / duration[index], 0.0, 1.0)
    progress = np.where(index < 0, 0.0, minimum_jerk(progress))
    first = np.maximum(index, 0)
    before = target[first]
    after = target[np.minimum(first + 1, count - 1)]
    return before + (after - before) * progress[:, None]


def _noise(
    rng: np.random.Generator,
    frames: int,
    rate_hz: float,
    shape: tuple[int, ...],
    seconds: float,
) -> Float[np.ndarray, "T ..."]:
    """Return band-limited Gaussian noise of unit variance that changes within ``seconds``."""
    sigma = seconds * rate_hz / 2
    white = rng.normal(size=(frames, *shape))
    smooth = gaussian_filter1d(white, sigma, axis=0, mode="reflect")
    return smooth * np.sqrt(2.0 * np.sqrt(np.pi) * sigma)


def _draw_restlessness(
    spec: ActionSpec,
    frames: int,
    rate_hz: float,
    rng: np.random.Generator,
) -> Float[np.ndarray, "T S 3"]:
    """Return the angles of the small movements that never stop."""
    shape = (len(SEGMENTS), 3)
    noise = _noise(rng, frames, rate_hz, shape, seconds=0.7)
    angles = np.deg2rad(noise * 1.3 * spec.energy)
    angles[:, Segment.PELVIS, :2] *= 0.5
    return angles


def _draw_legs(
    spec: ActionSpec,
    time: Float[np.ndarray, " T"],
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "T 11"], Float[np.ndarray, " T"]]:
    """Return the angles of legs and trunk, radians, and the height of the seat in statures."""
    hold = 0.7 * spec.stance
    legs = keyframes(rng, time, spec.legs, _LEGS_SPREAD, hold, reach=0.9)
    return np.deg2rad(legs[:, :11]), legs[:, 11] / 100.0


def _add_legs(angles: Float[np.ndarray, "T S 3"], legs: Float[np.ndarray, "T 11"]) -> None:
    angles[:, RIGHT.thigh] += legs[:, 0:3]
    angles[:, RIGHT.shank, 0] += legs[:, 3]
    angles[:, LEFT.thigh] += legs[:, 4:7]
    angles[:, LEFT.shank, 0] += legs[:, 7]
    angles[:, Segment.PELVIS, 0] += legs[:, 8]
    angles[:, Segment.LUMBAR, 0] += legs[:, 9]
    angles[:, Segment.THORAX, 0] += legs[:, 10]


def _draw_arm(
    spec: ActionSpec,
    postures: Postures,
    time: Float[np.ndarray, " T"],
    rng: np.random.Generator,
) -> Float[np.ndarray, "T 4"]:
    arm = keyframes(rng, time, postures, _ARM_SPREAD, spec.hold, spec.reach)
    return np.deg2rad(arm)


def _add_arm(
    angles: Float[np.ndarray, "T S 3"],
    side: Side,
    arm: Float[np.ndarray, "T 4"],
) -> None:
    angles[:, side.upper_arm] += arm[:, :3]
    angles[:, side.forearm, 0] += arm[:, 3]
    angles[:, side.forearm, 1:] = 0.0
    angles[:, side.shank, 1:] = 0.0
    # The shoulder girdle takes about a third of an arm's elevation above the horizontal.
    elevation = np.maximum(arm[:, 0], arm[:, 1])
    above_horizontal = np.logaddexp(0.0, 6.0 * (elevation - 1.0))
    angles[:, side.clavicle, 1] += 0.3 * above_horizontal / 6.0
    angles[:, side.clavicle, 2] += 0.1 * arm[:, 0]


def _draw_trunk(
    spec: ActionSpec,
    time: Float[np.ndarray, " T"],
    rng: np.random.Generator,
) -> Float[np.ndarray, "T 6"]:
    """Return the trunk's rotation, bending and flexion, and the neck's rotation, flexion, bending.

    Radians.
    """
    neutral = Postures(np.zeros((1, 6)), np.ones(1))
    bend = 0.25 * spec.twist
    spread = np.deg2rad([spec.twist, bend, bend, spec.look, 8.0, 6.0])
    return keyframes(rng, time, neutral, spread, spec.hold, reach=0.8)


def _add_trunk(angles: Float[np.ndarray, "T S 3"], trunk: Float[np.ndarray, "T 6"]) -> None:
    for segment in (Segment.LUMBAR, Segment.THORAX):
        angles[:, segment, 2] += 0.5 * trunk[:, 0]
        angles[:, segment, 1] += 0.5 * trunk[:, 1]
        angles[:, segment, 0] += 0.5 * trunk[:, 2]
    spine = [Segment.PELVIS, Segment.LUMBAR, Segment.THORAX]
    lean = angles[:, spine, 0].sum(axis=1)
    # People keep their gaze near the horizon when the trunk leans.
    angles[:, Segment.NECK, 0] += trunk[:, 4] - 0.5 * lean
    angles[:, Segment.NECK, 1] += trunk[:, 5]
    angles[:, Segment.NECK, 2] += trunk[:, 3]


def _draw_turn(
    spec: ActionSpec,
    time: Float[np.ndarray, " T"],
    rng: np.random.Generator,
) -> Float[np.ndarray, " T"]:
    """Return the heading of a body that stands, radians."""
    neutral = Postures(np.zeros((1, 1)), np.ones(1))
    spread = np.deg2rad(spec.turn)
    return keyframes(rng, time, neutral, spread, spec.stance, reach=1.2)[:, 0]


@dataclass(frozen=True)
class _Walk:
    """Where and when a body walks."""

    walking: Float[np.ndarray, " T"]
    """0 where it stands, 1 where it walks."""
    swing: Float[np.ndarray, " T"]
    """Size of the steps, 0 to 1."""
    strides: Float[np.ndarray, " T"]
    """Distance walked in steps of full size, mm."""
    path: Float[np.ndarray, "T 2"]
    """mm."""
    heading: Float[np.ndarray, " T"]
    """Radians."""


def _draw_walk(
    spec: ActionSpec,
    time: Float[np.ndarray, " T"],
    rate_hz: float,
    rng: np.random.Generator,
) -> _Walk:
    walking = _draw_walking(spec.walk, time, rng)
    variation = 1.0 + 0.06 * _noise(rng, len(time), rate_hz, (), seconds=1.5)
    speed = walking * spec.speed * 1000.0 * variation
    path, heading = walk_path(np.cumsum(speed) / rate_hz, rng)
    # Slower walking is slower steps and shorter ones in equal parts, so that feet and path agree.
    swing = np.sqrt(walking)
    step_speed = speed / np.maximum(swing, 1e-3)
    strides = np.cumsum(step_speed) / rate_hz
    return _Walk(walking, swing, strides, path, heading)


def _draw_walking(
    share: float,
    time: Float[np.ndarray, " T"],
    rng: np.random.Generator,
) -> Float[np.ndarray, " T"]:
    """Return a smooth 0 to 1 switch that is on for about ``share`` of the time."""
    if share in (0.0, 1.0):
        return np.full(len(time), share)
    switch = Postures(np.array([[0.0], [1.0]]), np.array([1.0 - share, share]))
    return keyframes(rng, time, switch, 0.0, hold=2.5, reach=0.7)[:, 0]


def _limit_hinges(angles: Float[np.ndarray, "T S 3"]) -> Float[np.ndarray, "T S 3"]:
    """Return the angles with elbows and knees bent one way, from about 2 to 150 degrees.

    The limit is smooth, so that speeds stay finite.
    """
    low = np.deg2rad(2.0)
    high = np.deg2rad(150.0)
    softness = np.deg2rad(3.0)
    flexion = angles[:, _HINGES, 0]
    flexion = low + softness * np.logaddexp(0.0, (flexion - low) / softness)
    flexion = high - softness * np.logaddexp(0.0, (high - flexion) / softness)
    limited = angles.copy()
    limited[:, _HINGES, 0] = flexion
    return limited
