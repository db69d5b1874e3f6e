import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ghpt.data.synthetic.body import CAPSULES, SEGMENTS, Body, Segment, pose, random_body
from ghpt.skeleton import BONES, JOINT, MIRROR

PARENT = {"knee": "hip", "ankle": "knee", "elbow": "shoulder", "wrist": "elbow"}


@pytest.fixture
def body() -> Body:
    return random_body(np.random.default_rng(3))


def random_angles(seed: int, frames: int = 50) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.2, 1.2, (frames, len(SEGMENTS), 3))


def bones(joints: np.ndarray) -> np.ndarray:
    return np.stack(
        [np.linalg.norm(joints[:, a] - joints[:, b], axis=-1) for a, b in BONES], axis=-1
    )


def opposite(segment: Segment) -> Segment:
    side, _, name = segment.name.partition("_")
    other = {"LEFT": "RIGHT", "RIGHT": "LEFT"}
    return Segment[f"{other[side]}_{name}"] if side in other else segment


def test_joint_angles_never_change_the_length_of_a_bone(body):
    lengths = bones(pose(body, random_angles(0)))
    np.testing.assert_allclose(lengths, np.broadcast_to(lengths[0], lengths.shape), atol=1e-9)


def test_turning_the_pelvis_turns_the_whole_body(body):
    angles = random_angles(1)
    turned = angles.copy()
    turned[:, Segment.PELVIS, 2] += 0.7
    expected = pose(body, angles) @ Rotation.from_euler("z", 0.7).as_matrix().T
    np.testing.assert_allclose(pose(body, turned), expected, atol=1e-9)


def test_exchanging_the_sides_mirrors_a_symmetric_body(body):
    offsets = body.offsets.copy()
    offsets[
        [JOINT[f"left_{j}"] for j in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")]
    ] = offsets[
        [JOINT[f"right_{j}"] for j in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")]
    ] * [1, -1, 1]
    symmetric = Body(body.stature, offsets)
    angles = random_angles(2)
    mirrored = angles[:, [opposite(segment) for segment in SEGMENTS]]
    middle = [Segment.PELVIS, Segment.LUMBAR, Segment.THORAX, Segment.NECK]
    mirrored[:, middle, 1:] *= -1
    expected = pose(symmetric, angles)[:, list(MIRROR)] * [1, -1, 1]
    np.testing.assert_allclose(pose(symmetric, mirrored), expected, atol=1e-9)


@pytest.mark.parametrize(
    ("segment", "column", "joint", "axis", "sign"),
    [
        ("right_upper_arm", 0, "right_elbow", 0, 1),
        ("left_upper_arm", 1, "left_elbow", 1, 1),
        ("right_upper_arm", 1, "right_elbow", 1, -1),
        ("right_forearm", 0, "right_wrist", 0, 1),
        ("left_shank", 0, "left_ankle", 0, -1),
        ("left_thigh", 0, "left_knee", 0, 1),
        ("lumbar", 0, "thorax", 0, 1),
        ("lumbar", 1, "thorax", 1, 1),
        ("pelvis", 0, "thorax", 0, 1),
        ("pelvis", 1, "thorax", 1, 1),
        ("neck", 2, "nose", 1, 1),
        ("right_clavicle", 1, "right_shoulder", 2, 1),
        ("left_clavicle", 2, "left_shoulder", 0, 1),
    ],
)
def test_positive_angles_move_the_way_their_names_say(body, segment, column, joint, axis, sign):
    angles = np.zeros((2, len(SEGMENTS), 3))
    angles[1, Segment[segment.upper()], column] = 0.3
    still, moved = pose(body, angles)[:, JOINT[joint]]
    assert sign * (moved - still)[axis] > 10.0


def test_people_differ_and_their_sides_differ_a_little():
    people = [random_body(np.random.default_rng(seed)) for seed in range(200)]
    statures = np.array([person.stature for person in people])
    assert 1680 < statures.mean() < 1780
    assert 50 < statures.std() < 100
    standing = np.concatenate([pose(person, np.zeros((1, len(SEGMENTS), 3))) for person in people])
    for joint, parent in PARENT.items():
        right, left = (
            np.linalg.norm(
                standing[:, JOINT[f"{side}_{joint}"]] - standing[:, JOINT[f"{side}_{parent}"]],
                axis=-1,
            )
            for side in ("right", "left")
        )
        assert 0.005 < np.std(left / right) < 0.02


def test_the_body_stands_as_tall_as_it_should(body):
    standing = pose(body, np.zeros((1, len(SEGMENTS), 3)))[0]
    height = standing[JOINT["head_top"], 2] - standing[JOINT["right_ankle"], 2]
    assert 0.85 < height / body.stature < 0.97
    assert all(0.01 < capsule.radius < 0.1 for capsule in CAPSULES)
