import numpy as np
import pytest

from ghpt.data.synthetic.actions import Postures, action_names
from ghpt.data.synthetic.body import random_body
from ghpt.data.synthetic.motion import keyframes, synthesize_motion
from ghpt.skeleton import BONES, JOINT, JOINTS, PELVIS

RATE = 50.0
HUMAN36M = {
    "Directions",
    "Discussion",
    "Eating",
    "Greeting",
    "Phoning",
    "Posing",
    "Purchases",
    "Sitting",
    "SittingDown",
    "Smoking",
    "TakingPhoto",
    "Waiting",
    "Walking",
    "WalkingDog",
    "WalkingTogether",
}


def take(action: str, seed: int = 0, frames: int = 1000) -> tuple[np.ndarray, float]:
    rng = np.random.default_rng(seed)
    body = random_body(rng)
    return synthesize_motion(body, action, frames, RATE, rng), body.stature


def speed(joints: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.diff(joints, axis=0), axis=-1) * RATE


def bend(joints: np.ndarray, side: str, chain: tuple[str, str, str]) -> np.ndarray:
    a, b, c = (joints[:, JOINT[f"{side}_{name}"]] for name in chain)
    u, v = b - a, c - b
    cosine = (u * v).sum(-1) / np.linalg.norm(u, axis=-1) / np.linalg.norm(v, axis=-1)
    return np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))


def test_the_15_actions_are_there():
    assert set(action_names()) == HUMAN36M | {"RangeOfMotion"}


@pytest.mark.parametrize("action", action_names())
def test_motion_is_possible(action):
    joints, stature = take(action)
    assert joints.shape == (1000, len(JOINTS), 3)
    assert np.isfinite(joints).all()
    for a, b in BONES[:6]:
        length = np.linalg.norm(joints[:, a] - joints[:, b], axis=-1)
        np.testing.assert_allclose(length, length[0], rtol=1e-9)
    assert speed(joints).max() < 8000
    assert np.abs(np.diff(joints, 2, axis=0)).max() * RATE**2 < 250_000
    assert np.abs(joints[:, PELVIS, :2]).max() < 2200
    for side in ("right", "left"):
        for chain in (("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist")):
            assert bend(joints, side, chain).max() < 155
    lowest = joints[
        :, [JOINT["right_ankle"], JOINT["left_ankle"], JOINT["right_knee"], PELVIS], 2
    ].min(axis=1)
    assert lowest.min() > 0
    assert lowest.max() < 0.14 * stature


@pytest.mark.parametrize("action", action_names())
def test_knees_bend_backward(action):
    joints, _ = take(action, seed=1)
    across = joints[:, JOINT["left_hip"]] - joints[:, JOINT["right_hip"]]
    for side in ("right", "left"):
        hip, knee, ankle = (joints[:, JOINT[f"{side}_{name}"]] for name in ("hip", "knee", "ankle"))
        forward = np.cross(across, hip - knee)
        assert ((ankle - knee) * forward).sum(axis=-1).max() < 0


@pytest.mark.parametrize("action", action_names())
def test_elbows_bend_one_way_about_the_upper_arm(action):
    # However the arm is turned, the shoulder-elbow-wrist plane's normal has one sign against the
    # humeral axis' x: so a straight arm is never passed.
    joints, _ = take(action, seed=2)
    for side in ("right", "left"):
        bent = bend(joints, side, ("shoulder", "elbow", "wrist"))
        normal = np.cross(
            joints[:, JOINT[f"{side}_elbow"]] - joints[:, JOINT[f"{side}_shoulder"]],
            joints[:, JOINT[f"{side}_wrist"]] - joints[:, JOINT[f"{side}_elbow"]],
        )
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        turned = (normal[1:] * normal[:-1]).sum(axis=-1)
        assert bent.min() > 1.0
        assert turned.min() > 0.5


def test_a_walk_moves_at_its_speed_and_its_feet_stand_still():
    joints, _ = take("Walking")
    over_the_floor = np.linalg.norm(np.diff(joints[:, PELVIS, :2], axis=0), axis=-1) * RATE
    assert 1000 < over_the_floor.mean() < 1500
    ankles = joints[:, [JOINT["right_ankle"], JOINT["left_ankle"]]]
    standing = ankles[1:, :, 2] < ankles[1:, :, 2].min(axis=1, keepdims=True) + 3
    assert np.median(speed(ankles)[standing]) < 200
    assert speed(ankles).max() > 2500


def test_the_walker_faces_the_way_it_goes():
    joints, _ = take("Walking", seed=4)
    across = joints[:, JOINT["left_hip"]] - joints[:, JOINT["right_hip"]]
    forward = np.stack([across[:, 1], -across[:, 0]], axis=-1)[25:-25]
    going = joints[50:, PELVIS, :2] - joints[:-50, PELVIS, :2]
    cosine = (
        (forward * going).sum(-1)
        / np.linalg.norm(forward, axis=-1)
        / np.linalg.norm(going, axis=-1)
    )
    assert np.median(cosine) > 0.9


def test_who_sits_is_low_and_who_stands_is_not():
    def pelvis_height(action: str) -> float:
        joints, stature = take(action)
        return float(np.median(joints[:, PELVIS, 2]) / stature)

    assert pelvis_height("SittingDown") < 0.25
    assert 0.25 < pelvis_height("Sitting") < 0.38
    assert pelvis_height("Directions") > 0.5


def test_left_handed_people_use_the_other_hand():
    rng = np.random.default_rng
    body = random_body(rng(0))
    lifted = [
        synthesize_motion(body, "Phoning", 500, RATE, rng(1), left_handed)[
            :, [JOINT["right_wrist"], JOINT["left_wrist"]], 2
        ]
        for left_handed in (False, True)
    ]
    assert (np.diff(lifted[0].mean(axis=0)) < 0).all()
    assert (np.diff(lifted[1].mean(axis=0)) > 0).all()


def test_keyframes_rest_in_the_postures_and_stay_between_them():
    time = np.arange(4000) / RATE
    postures = Postures(np.array([[0.0, 1.0], [1.0, 0.0]]), np.array([1.0, 3.0]))
    curve = keyframes(np.random.default_rng(5), time, postures, 0.0, hold=1.0, reach=0.5)
    assert curve.min() >= 0
    assert curve.max() <= 1
    resting = np.abs(np.diff(curve[:, 0])) == 0
    np.testing.assert_allclose(curve[:-1][resting] % 1.0, 0.0)
    assert 0.5 < resting.mean() < 0.98
    assert 0.6 < curve[:, 0].mean() < 0.9


def test_motion_is_a_function_of_its_generator():
    first, second, other = (take("Posing", seed, 200)[0] for seed in (7, 7, 8))
    np.testing.assert_array_equal(first, second)
    assert np.abs(first - other).max() > 100
