"""OpenPose's folders: frames by their numbers, missing ones missing, and one person followed
through each view.
"""

import json

import numpy as np
import pytest

from ghpt.data.formats.key_points import read_key_points
from ghpt.data.formats.skeletons import SKELETONS
from ghpt.data.people.following import follow
from ghpt.errors import GhptDataError
from single_person import read_person

RNG = np.random.default_rng(0)
BODY = RNG.uniform(0, 400, (25, 2))
JOINTS = {"skeleton": "body_25b"}


def person(x: float = 0, size: float = 1, confidence: float = 0.8) -> np.ndarray:
    return np.concatenate([BODY * size + [x, 0], np.full((25, 1), confidence)], -1)


def write(folder, people, name="cam1_{:012d}_keypoints.json", frames=None):
    folder.mkdir(parents=True, exist_ok=True)
    for frame, found in zip(frames or range(len(people)), people, strict=True):
        content = {
            "version": 1.3,
            "people": [{"pose_keypoints_2d": p.ravel().tolist()} for p in found],
        }
        (folder / name.format(frame)).write_text(json.dumps(content))


def test_frames_keep_their_numbers_and_gaps_stay_gaps(tmp_path):
    write(tmp_path / "cam1", [[person(t)] for t in range(6)])
    write(
        tmp_path / "cam2",
        [[person(100 + t)] for t in (0, 2, 3, 7)],
        "x.{:04d}.json",
        frames=[0, 2, 3, 7],
    )
    found = read_person(tmp_path, **JOINTS)
    assert found.frame.tolist() == [0, 1, 2, 3, 4, 5, 7]
    assert found.valid[:, 0, 0].tolist() == [True] * 6 + [False]
    assert found.valid[:, 1, 0].tolist() == [True, False, True, True, False, False, True]
    np.testing.assert_allclose(
        found.key_points[[0, 2, 3, 6], 1, :, 0] - BODY[:, 0],
        np.array([[100], [102], [103], [107]]) + np.zeros(25),
    )
    assert found.joints == SKELETONS["body_25b"]


def test_zeros_are_missing_and_confidence_stays_in_its_range(tmp_path):
    one = person()
    one[3], one[4, 2] = 0, 1.04
    write(tmp_path / "cam1", [[one], []])
    write(tmp_path / "cam2", [[person()], [person()]])
    found = read_person(tmp_path, **JOINTS)
    assert not found.valid[0, 0, 3]
    assert found.valid[0, 0].sum() == 24
    assert not found.valid[1, 0].any()
    assert found.confidence.max() == 1


def test_the_person_tracked_best_is_followed_wherever_the_list_has_them():
    """A small unsure passer-by, listed first or last; and one who is larger for some frames, but
    passes.
    """
    rng = np.random.default_rng(1)
    people, truth = [], []
    for t in range(40):
        main, other = person(5 * t), person(900 - 8 * t, 0.4, 0.4)
        found = [main, other]
        if 10 <= t < 16:
            found.append(person(1500, 1.5, 0.9))
        order = rng.permutation(len(found))
        people.append(np.stack([found[i] for i in order]))
        truth.append(int(np.flatnonzero(order == 0)[0]))
    people[20] = np.zeros((0, 25, 3))
    truth[20] = -1
    assert follow(people).tolist() == truth


def test_following_is_the_best_of_all_choices():
    """Against every choice of one person a frame, by brute force."""
    from itertools import product

    from ghpt.data.people.following import _JUMP, _jump, _prominence

    rng = np.random.default_rng(5)
    people = [
        np.stack(
            [
                person(rng.uniform(0, 300), rng.uniform(0.5, 1.5), rng.uniform(0.2, 1))
                for _ in range(3)
            ]
        )
        for _ in range(5)
    ]
    quality = np.stack([_prominence(found) for found in people]) / max(
        _prominence(found).max() for found in people
    )

    def value(choice):
        jumps = sum(_jump(people[t], people[t + 1])[choice[t], choice[t + 1]] for t in range(4))
        return sum(quality[t, c] for t, c in enumerate(choice)) - _JUMP * jumps

    assert tuple(follow(people)) == max(product(range(3), repeat=5), key=value)


def test_a_confidence_of_nothing_is_not_seen_wherever_the_point_is(tmp_path):
    one = person()
    one[3:6, 2] = 0, -0.1, 1e-6
    write(tmp_path / "cam1", [[one]])
    write(tmp_path / "cam2", [[person()]])
    found = read_person(tmp_path, **JOINTS)
    assert found.valid[0, 0, 2:6].tolist() == [True, False, False, True]


def test_missing_joints_make_nobody_large():
    """They are at 0, 0: far from someone who is small and at the other side of the image."""
    small = person(900, 0.3)
    small[5] = 0
    assert follow([np.stack([person(), small])]).tolist() == [0]
    assert follow([np.stack([small, person()])] * 3).tolist() == [1] * 3


def test_a_jump_costs_twice_its_distance_in_sizes():
    """Of someone sure who is 0.35 sizes away: 0.7 of a quality."""
    away = person(0.35 * np.linalg.norm(np.ptp(BODY, axis=0)), confidence=1)
    for confidence, chosen in ((0.2, 1), (0.4, 0)):
        frames = [person(confidence=1)[None], np.stack([person(confidence=confidence), away])]
        assert follow(frames).tolist() == [0, chosen]


def test_of_two_people_the_larger_is_followed_whoever_is_listed_first(tmp_path):
    for view in ("a", "b"):
        write(tmp_path / view, [[person(900, 0.3), person()]] * 2)
    found = read_person(tmp_path, **JOINTS)
    np.testing.assert_allclose(found.key_points, np.broadcast_to(BODY, (2, 2, 25, 2)))


def test_person_ids_are_those_of_the_view(tmp_path):
    def write_ids(view, ids):
        (tmp_path / view).mkdir(exist_ok=True)
        people = [{"person_id": [i], "pose_keypoints_2d": person().ravel().tolist()} for i in ids]
        (tmp_path / view / "1.json").write_text(json.dumps({"people": people}))

    write_ids("a", [1, 0])
    write_ids("b", [7, 9])
    assert read_key_points(tmp_path, **JOINTS).identity.tolist() == [1, 0, 7, 9]
    for other in (-1, True, 1 << 31, "1"):
        write_ids("b", [7, 9, other])
        assert read_key_points(tmp_path, **JOINTS).identity.tolist() == [1, 0, 7, 9, -1]


@pytest.mark.parametrize("ids", [[4, 4], [0, 0, 1]])
def test_a_number_that_two_people_of_a_frame_have_is_no_tracker_s(ids, tmp_path):
    for view in ("a", "b"):
        (tmp_path / view).mkdir()
        people = [{"person_id": [i], "pose_keypoints_2d": person().ravel().tolist()} for i in ids]
        (tmp_path / view / "1.json").write_text(json.dumps({"people": people}))
    assert set(read_key_points(tmp_path, **JOINTS).identity.tolist()) == {-1}


def test_64_people_are_read_and_a_pixel_below_a_million(tmp_path):
    one = person()
    one[0, 0] = 999_999.5
    for view in ("a", "b"):
        write(tmp_path / view, [[one] * 64])
    assert len(read_key_points(tmp_path, **JOINTS)) == 128
    one[0, 0] = -1e6
    write(tmp_path / "a", [[one]])
    with pytest.raises(GhptDataError, match="beyond 1e6"):
        read_key_points(tmp_path, **JOINTS)


def test_the_number_of_people_is_told(tmp_path):
    write(tmp_path / "a", [[person(), person(900)], [person()], []])
    write(tmp_path / "b", [[person()]] * 3)
    assert read_key_points(tmp_path, **JOINTS).crowded_frames() == {"a": 1}


def test_cameras_without_a_common_frame_are_refused(tmp_path):
    write(tmp_path / "a", [[person()]] * 2, frames=[1, 2])
    write(tmp_path / "b", [[person()]] * 2, frames=[3, 4])
    with pytest.raises(GhptDataError, match=r"no frame is in all views \(a 1 to 2, b 3 to 4\)"):
        read_person(tmp_path, **JOINTS)


def test_bad_folders_are_named(tmp_path):
    with pytest.raises(GhptDataError, match=r"is not a key-point format that is known"):
        read_person(tmp_path)
    with pytest.raises(GhptDataError, match=r"holds no JSON file.*each camera"):
        read_person(tmp_path, format="openpose")
    for view in ("a", "b"):
        write(tmp_path / view, [[]] * 3)
    with pytest.raises(GhptDataError, match="people: is empty"):
        read_person(tmp_path)
    write(tmp_path / "b", [[person()]] * 3)
    with pytest.raises(GhptDataError, match="view a: has no key point"):
        read_person(tmp_path, **JOINTS)
    with pytest.raises(GhptDataError, match="Name the folder above"):
        read_person(tmp_path / "a")


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("x.json", "{}", "its name has no frame number"),
        ("01.json", '{"people": []}', "has the frame number 1, as"),
        ("9.json", '{"people": [', "is not valid JSON"),
        ("9.json", '{"people": 1}', "people: is not a list of people"),
        ("9.json", '{"people": [{"x": 1}]}', r"people\[0\]: has no key points"),
        (
            "9.json",
            '{"people": [{"pose_keypoints_2d": [1, 2]}]}',
            "is not a list of x, y, confidence",
        ),
        ("9.json", '{"people": [{"pose_keypoints_2d": [Infinity, 2, 3]}]}', "no JSON number"),
        ("9.json", "{}", "is not a key-point format"),
        ("9.json", '[{"frame_id": 1, "instances": []}]', "holds a recording"),
        (
            "9.json",
            '{"people": [{"pose_keypoints_2d": [1e300, 2, 3]}]}',
            "holds a number beyond 1e6",
        ),
        (
            "9.json",
            '{"people": [{"pose_keypoints_2d": [1, 2, 3]}]}',
            "people of 1 joints, the files before of 25",
        ),
        (
            "9.json",
            '{"people": [' + ",".join(['{"pose_keypoints_2d": []}'] * 65) + "]}",
            "65 people are in a frame",
        ),
    ],
)
def test_a_bad_file_is_named(name, content, says, tmp_path):
    for view in ("a", "b"):
        write(tmp_path / view, [[person()]] * 3, "{}.json")
    (tmp_path / "a" / name).write_text(content)
    with pytest.raises(GhptDataError, match=says):
        read_key_points(tmp_path, **JOINTS)


def test_the_real_recording(shared_data):
    found = read_person(shared_data / "pose2sim_single" / "pose")
    assert found.views == ("cam1_json", "cam2_json", "cam3_json", "cam4_json")
    assert found.joints == SKELETONS["body_25b"]
    assert found.frame.tolist() == list(range(100))
    people = read_key_points(shared_data / "pose2sim_single" / "pose")
    assert people.crowded_frames() == {"cam1_json": 100, "cam2_json": 100}
    size = (
        np.where(found.valid[..., None], found.key_points, np.inf).min(2),
        np.where(found.valid[..., None], found.key_points, -np.inf).max(2),
    )
    # of the other person, at the edge of two views, less than 500 pixels are seen
    assert (np.linalg.norm(size[1] - size[0], axis=-1) > 500).all()


def write_with_hands(folder, hands):
    """Two frames of a walker's body in two views; ``hands`` of each frame, by OpenPose's name."""
    body = person_of("body_25")
    for view in ("cam1", "cam2"):
        (folder / view).mkdir(parents=True)
        for frame, own in enumerate(hands):
            points = {name: values.ravel().tolist() for name, values in own.items()}
            content = {"people": [{"pose_keypoints_2d": body.ravel().tolist(), **points}]}
            (folder / view / f"{view}_{frame}_keypoints.json").write_text(json.dumps(content))
    return folder


def person_of(skeleton):
    """A standing person of a skeleton, with distinct places."""
    height = {"ankle": 0, "heel": 0, "toe": 0, "knee": 50, "hip": 95, "neck": 145, "shoulder": 143}
    height |= {"elbow": 115, "wrist": 95}
    rows = []
    for name in SKELETONS[skeleton]:
        side = 20 if "left" in name else -20 if "right" in name else 0
        up = next((h for part, h in height.items() if part in name), 160)
        rows.append((500 + side, 500 - up + len(rows) / 100, 0.9))
    return np.array(rows)


HAND = np.stack([np.arange(21) + 300.0, np.arange(21) + 400.0, np.full(21, 0.8)], axis=-1)


def test_openpose_s_hands_come_behind_the_body(tmp_path):
    """A hand that is not found in a frame is missing there."""
    found = read_key_points(
        write_with_hands(
            tmp_path, [{"hand_left_keypoints_2d": HAND}, {"hand_left_keypoints_2d": HAND[:0]}]
        )
    )
    assert found.joints == SKELETONS["body_25_hands"]
    left = [found.joints.index(name) for name in SKELETONS["body_25_hands"][25:46]]
    first, second = found.points[:2].valid
    assert first[left].all()
    assert not second[left].any()
    assert not first[46:].any()
    np.testing.assert_array_equal(found.points.pixels[0][left], HAND[:, :2])


def test_hands_are_left_out_for_a_skeleton_without_them(tmp_path):
    folder = write_with_hands(tmp_path, [{"hand_right_keypoints_2d": HAND}])
    assert read_key_points(folder, "body_25").joints == SKELETONS["body_25"]
    assert read_key_points(folder, "body_25_hands").joints == SKELETONS["body_25_hands"]


def test_faces_are_left_out_and_said(tmp_path, caplog):
    caplog.set_level("INFO")
    folder = write_with_hands(tmp_path, [{"face_keypoints_2d": np.ones((70, 3))}])
    assert read_key_points(folder).joints == SKELETONS["body_25"]
    assert "faces are not read" in caplog.text


def test_half_a_hand_is_named(tmp_path):
    folder = write_with_hands(tmp_path, [{"hand_left_keypoints_2d": HAND[:20]}])
    with pytest.raises(GhptDataError, match=r"hand_left_keypoints_2d: are 20 points, not 21"):
        read_key_points(folder)
