"""Smooth human motion by action: joint angles that move between postures.

Postures and how often each action takes them are in ``actions.yaml``. World frame: mm, z up, floor
at z = 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from ghpt.data.synthetic.body import SEGMENT, SEGMENTS, Body, pose
from ghpt.data.synthetic.gait import REST, STRIDE, blend_gait, gait, root_motion, walk_path


def actions() -> tuple[str, ...]:
    """Human3.6M's 15 actions by name, and RangeOfMotion as people are asked for in Panoptic Studio."""
    return tuple(_tables()["actions"])


@cache
def _tables() -> dict[str, Any]:
    return yaml.safe_load(
        resources.files("ghpt.data.synthetic").joinpath("actions.yaml").read_text(encoding="utf-8")
    )


def move(
    body: Body,
    action: str,
    frames: int,
    rate_hz: float,
    rng: np.random.Generator,
    left_handed: bool = False,
) -> Float[np.ndarray, "T J 3"]:
    """A take of one action of ``actions.yaml``: joints in mm, z up, feet on z = 0, near the world's
    origin.
    """
    entry = _tables()["actions"][action]
    spec = entry | {name: float(value) for name, value in entry["habits"].items()}
    time = np.arange(frames) / rate_hz
    legs, seat = _legs(spec, time, rng)
    angles = np.zeros((frames, len(SEGMENTS), 3))
    angles += np.deg2rad(
        _restless(rng, frames, rate_hz, angles.shape[1:], seconds=0.7) * 1.3 * spec["energy"]
    )
    angles[:, SEGMENT["pelvis"], :2] *= 0.5
    _set_legs(angles, legs)
    for side, habit in (
        ("right", "other" if left_handed else "hand"),
        ("left", "hand" if left_handed else "other"),
    ):
        _set_arm(angles, side, _arm(spec, spec[habit], time, rng))
    _set_trunk(angles, spec, time, rng)
    turn = keyframes(
        rng,
        time,
        np.zeros((1, 1)),
        [1.0],
        np.deg2rad(spec["turn"]),
        spec["stance"],
        reach=1.2,
    )[:, 0]

    walking = _share_of_time(spec["walk"], time, rng)
    speed = (
        walking
        * spec["speed"]
        * 1000.0
        * (1.0 + 0.06 * _restless(rng, frames, rate_hz, (), seconds=1.5))
    )
    path, heading = walk_path(np.cumsum(speed) / rate_hz, rng)
    if spec["walk"] == 0:
        path = 0.3 * path  # who does not walk stands near the middle
    else:
        # Slower walking is slower steps and shorter ones in equal parts, so that feet and path
        # agree.
        swing = np.sqrt(walking)
        phase = rng.uniform() + np.cumsum(speed / np.maximum(swing, 1e-3)) / rate_hz / (
            STRIDE * body.stature
        )
        angles = blend_gait(angles, gait(body, phase), swing)
    # Who walks faces where the path leads.
    angles[:, SEGMENT["pelvis"], 2] += heading + (1.0 - walking) * turn
    joints = pose(body, _within_reach(angles))
    rest = np.tile(REST, (frames, 1))
    rest[:, -1] = seat
    return joints + root_motion(joints, path, rest * body.stature, rate_hz)[:, None]


def keyframes(
    rng: np.random.Generator,
    time: Float[np.ndarray, " T"],
    postures: Float[np.ndarray, "P D"],
    weights: Sequence[float],
    spread: Float[np.ndarray, " D"] | float,
    hold: float,
    reach: float,
) -> Float[np.ndarray, "T D"]:
    """Rest in a random posture (mean ``hold`` s), move to the next along a minimum-jerk curve (mean
    ``reach`` s).
    """
    count = int(time[-1] / (0.35 * hold + 0.7 * reach)) + 2
    chosen = rng.choice(len(postures), count, p=np.asarray(weights, float) / np.sum(weights))
    target = postures[chosen] + rng.normal(0.0, 1.0, (count, postures.shape[1])) * spread
    moving = reach * rng.uniform(0.7, 1.6, count)
    start = np.cumsum(hold * (0.35 + rng.exponential(0.65, count)) + np.r_[0.0, moving[:-1]])
    index = np.searchsorted(start, time, side="right") - 1
    done = np.clip((time - start[index]) / moving[index], 0.0, 1.0)[:, None]
    done = np.where(index[:, None] < 0, 0.0, done**3 * (10.0 - 15.0 * done + 6.0 * done**2))
    before = target[np.maximum(index, 0)]
    after = target[np.minimum(np.maximum(index, 0) + 1, count - 1)]
    return before + (after - before) * done


def _restless(
    rng: np.random.Generator, frames: int, rate_hz: float, shape: tuple[int, ...], seconds: float
) -> Float[np.ndarray, "T ..."]:
    """Band-limited Gaussian noise of unit variance that changes within ``seconds``."""
    sigma = seconds * rate_hz / 2
    noise = gaussian_filter1d(rng.normal(size=(frames, *shape)), sigma, axis=0, mode="reflect")
    return noise * np.sqrt(2.0 * np.sqrt(np.pi) * sigma)


def _table(name: str, weights: Mapping[str, int]) -> tuple[Float[np.ndarray, "P D"], list[float]]:
    return np.array([_tables()[name][posture] for posture in weights], dtype=float), [
        float(w) for w in weights.values()
    ]


def _legs(
    spec: Mapping[str, Any], time: Float[np.ndarray, " T"], rng: np.random.Generator
) -> tuple[Any, Any]:
    postures, weights = _table("legs", spec["legs"])
    spread = np.array([3.0, 2.0, 3.0, 4.0] * 2 + [2.0, 3.0, 3.0, 0.5])
    legs = keyframes(rng, time, postures, weights, spread, hold=0.7 * spec["stance"], reach=0.9)
    return np.deg2rad(legs[:, :11]), legs[:, 11] / 100.0


def _set_legs(angles: Float[np.ndarray, "T S 3"], legs: Float[np.ndarray, "T 11"]) -> None:
    for first, side in ((0, "right"), (4, "left")):
        angles[:, SEGMENT[f"{side}_thigh"]] += legs[:, first : first + 3]
        angles[:, SEGMENT[f"{side}_shank"], 0] += legs[:, first + 3]
    for column, segment in enumerate(("pelvis", "lumbar", "thorax"), start=8):
        angles[:, SEGMENT[segment], 0] += legs[:, column]


def _arm(
    spec: Mapping[str, Any],
    habit: Mapping[str, int],
    time: Float[np.ndarray, " T"],
    rng: np.random.Generator,
) -> Float[np.ndarray, "T 4"]:
    postures, weights = _table("arms", habit)
    spread = np.array([8.0, 6.0, 9.0, 9.0])
    return np.deg2rad(keyframes(rng, time, postures, weights, spread, spec["hold"], spec["reach"]))


def _set_arm(angles: Float[np.ndarray, "T S 3"], side: str, arm: Float[np.ndarray, "T 4"]) -> None:
    angles[:, SEGMENT[f"{side}_upper_arm"]] += arm[:, :3]
    angles[:, SEGMENT[f"{side}_forearm"], 0] += arm[:, 3]
    angles[:, SEGMENT[f"{side}_forearm"], 1:] = 0.0
    angles[:, SEGMENT[f"{side}_shank"], 1:] = 0.0
    # The shoulder girdle takes about a third of an arm's elevation above the horizontal.
    raised = np.maximum(arm[:, 0], arm[:, 1])
    angles[:, SEGMENT[f"{side}_clavicle"], 1] += 0.3 * np.logaddexp(0.0, 6.0 * (raised - 1.0)) / 6.0
    angles[:, SEGMENT[f"{side}_clavicle"], 2] += 0.1 * arm[:, 0]


def _set_trunk(
    angles: Float[np.ndarray, "T S 3"],
    spec: Mapping[str, Any],
    time: Float[np.ndarray, " T"],
    rng: np.random.Generator,
) -> None:
    zero = np.zeros((1, 6))
    spread = np.deg2rad(
        [spec["twist"], 0.25 * spec["twist"], 0.25 * spec["twist"], spec["look"], 8.0, 6.0]
    )
    trunk = keyframes(rng, time, zero, [1.0], spread, hold=spec["hold"], reach=0.8)
    for segment in ("lumbar", "thorax"):
        angles[:, SEGMENT[segment], 2] += 0.5 * trunk[:, 0]
        angles[:, SEGMENT[segment], 1] += 0.5 * trunk[:, 1]
        angles[:, SEGMENT[segment], 0] += 0.5 * trunk[:, 2]
    lean = angles[:, [SEGMENT["pelvis"], SEGMENT["lumbar"], SEGMENT["thorax"]], 0].sum(axis=1)
    # People keep their gaze near the horizon when the trunk leans.
    angles[:, SEGMENT["neck"], 0] += trunk[:, 4] - 0.5 * lean
    angles[:, SEGMENT["neck"], 1] += trunk[:, 5]
    angles[:, SEGMENT["neck"], 2] += trunk[:, 3]


def _share_of_time(
    share: float, time: Float[np.ndarray, " T"], rng: np.random.Generator
) -> Float[np.ndarray, " T"]:
    """A smooth 0 to 1 switch that is on for about ``share`` of the time."""
    if share in (0.0, 1.0):
        return np.full(len(time), share)
    return keyframes(
        rng,
        time,
        np.array([[0.0], [1.0]]),
        [1.0 - share, share],
        0.0,
        hold=2.5,
        reach=0.7,
    )[:, 0]


def _within_reach(angles: Float[np.ndarray, "T S 3"]) -> Float[np.ndarray, "T S 3"]:
    """Elbows and knees bend one way, from about 2 to 150 degrees: a smooth limit, so that speeds
    stay finite.
    """
    hinges = [
        SEGMENT[f"{side}_{part}"] for side in ("right", "left") for part in ("forearm", "shank")
    ]
    low = np.deg2rad(2.0)
    high = np.deg2rad(150.0)
    softness = np.deg2rad(3.0)
    bent = low + softness * np.logaddexp(0.0, (angles[:, hinges, 0] - low) / softness)
    angles = angles.copy()
    angles[:, hinges, 0] = high - softness * np.logaddexp(0.0, (high - bent) / softness)
    return angles
