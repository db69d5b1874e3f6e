"""The joint tables against literal ones: the detectors' own documentation, and people whom the
detectors saw.

Nothing here is made from the tables that it tests. The words and their order are those of
OpenPose's output format (BODY_25, BODY_25B, COCO), COCO's and Halpe's annotation formats,
MediaPipe's pose landmarks, CMU Panoptic's tool box, and the order of the paper's authors for
Human3.6M.
"""

from itertools import combinations, pairwise

import numpy as np
import pytest

from ghpt.data.datasets import panoptic
from ghpt.data.datasets.panoptic_joints import COCO19
from ghpt.data.formats.skeletons import SKELETONS, canonical, joints17
from ghpt.data.points import KeyPoints
from ghpt.skeleton import BONES, JOINTS, MIRROR, SIX_JOINTS, SYMMETRIC_BONES
from single_person import read_person

DOCUMENTED = {
    "human36m": """
        0 right_ankle, 1 right_knee, 2 right_hip, 3 left_hip, 4 left_knee, 5 left_ankle, 6 pelvis,
        7 spine, 8 thorax, 9 head_top, 10 right_wrist, 11 right_elbow, 12 right_shoulder,
        13 left_shoulder, 14 left_elbow, 15 left_wrist, 16 nose""",
    "coco_17": """
        0 nose, 1 left_eye, 2 right_eye, 3 left_ear, 4 right_ear, 5 left_shoulder,
        6 right_shoulder, 7 left_elbow, 8 right_elbow, 9 left_wrist, 10 right_wrist, 11 left_hip,
        12 right_hip, 13 left_knee, 14 right_knee, 15 left_ankle, 16 right_ankle""",
    "coco_18": """
        0 Nose, 1 Neck, 2 RShoulder, 3 RElbow, 4 RWrist, 5 LShoulder, 6 LElbow, 7 LWrist, 8 RHip,
        9 RKnee, 10 RAnkle, 11 LHip, 12 LKnee, 13 LAnkle, 14 REye, 15 LEye, 16 REar, 17 LEar""",
    "coco_19": """
        0 Neck, 1 Nose, 2 BodyCenter, 3 lShoulder, 4 lElbow, 5 lWrist, 6 lHip, 7 lKnee, 8 lAnkle,
        9 rShoulder, 10 rElbow, 11 rWrist, 12 rHip, 13 rKnee, 14 rAnkle, 15 lEye, 16 lEar,
        17 rEye, 18 rEar""",
    "body_25": """
        0 Nose, 1 Neck, 2 RShoulder, 3 RElbow, 4 RWrist, 5 LShoulder, 6 LElbow, 7 LWrist,
        8 MidHip, 9 RHip, 10 RKnee, 11 RAnkle, 12 LHip, 13 LKnee, 14 LAnkle, 15 REye, 16 LEye,
        17 REar, 18 LEar, 19 LBigToe, 20 LSmallToe, 21 LHeel, 22 RBigToe, 23 RSmallToe, 24 RHeel""",
    "body_25b": """
        0 Nose, 1 LEye, 2 REye, 3 LEar, 4 REar, 5 LShoulder, 6 RShoulder, 7 LElbow, 8 RElbow,
        9 LWrist, 10 RWrist, 11 LHip, 12 RHip, 13 LKnee, 14 RKnee, 15 LAnkle, 16 RAnkle,
        17 UpperNeck, 18 HeadTop, 19 LBigToe, 20 LSmallToe, 21 LHeel, 22 RBigToe, 23 RSmallToe,
        24 RHeel""",
    "halpe_26": """
        0 Nose, 1 LEye, 2 REye, 3 LEar, 4 REar, 5 LShoulder, 6 RShoulder, 7 LElbow, 8 RElbow,
        9 LWrist, 10 RWrist, 11 LHip, 12 RHip, 13 LKnee, 14 RKnee, 15 LAnkle, 16 RAnkle, 17 Head,
        18 Neck, 19 Hip, 20 LBigToe, 21 RBigToe, 22 LSmallToe, 23 RSmallToe, 24 LHeel, 25 RHeel""",
    "mediapipe_33": """
        0 nose, 1 left eye inner, 2 left eye, 3 left eye outer, 4 right eye inner, 5 right eye,
        6 right eye outer, 7 left ear, 8 right ear, 9 mouth left, 10 mouth right,
        11 left shoulder, 12 right shoulder, 13 left elbow, 14 right elbow, 15 left wrist,
        16 right wrist, 17 left pinky, 18 right pinky, 19 left index, 20 right index,
        21 left thumb, 22 right thumb, 23 left hip, 24 right hip, 25 left knee, 26 right knee,
        27 left ankle, 28 right ankle, 29 left heel, 30 right heel, 31 left foot index,
        32 right foot index""",
}
FINGERS = ("thumb", "forefinger", "middle_finger", "ring_finger", "pinky_finger")
WHOLE_BODY = {"coco_133": 17 + 6, "halpe_136": 26}
"""Key points before the face's 68 and the hands' 21 each, left first."""


def whole_body(body: str, first: int) -> str:
    words = [body, *(f"{first + i} face {i}" for i in range(68))]
    for hand, side in enumerate(("left", "right")):
        start = first + 68 + 21 * hand
        parts = ["hand root", *(f"{finger}{k}" for finger in FINGERS for k in (1, 2, 3, 4))]
        words += [f"{start + i} {side} {part}" for i, part in enumerate(parts)]
    return ", ".join(words)


COCO_FEET = """
    17 LBigToe, 18 LSmallToe, 19 LHeel, 20 RBigToe, 21 RSmallToe, 22 RHeel"""
DOCUMENTED |= {
    "mpii_16": """
        0 RAnkle, 1 RKnee, 2 RHip, 3 LHip, 4 LKnee, 5 LAnkle, 6 pelvis, 7 thorax, 8 UpperNeck,
        9 HeadTop, 10 RWrist, 11 RElbow, 12 RShoulder, 13 LShoulder, 14 LElbow, 15 LWrist""",
    "mpi_15": """
        0 Head, 1 Neck, 2 RShoulder, 3 RElbow, 4 RWrist, 5 LShoulder, 6 LElbow, 7 LWrist, 8 RHip,
        9 RKnee, 10 RAnkle, 11 LHip, 12 LKnee, 13 LAnkle, 14 Chest""",
    "coco_133": whole_body(f"{DOCUMENTED['coco_17']}, {COCO_FEET}", WHOLE_BODY["coco_133"]),
    "halpe_136": whole_body(DOCUMENTED["halpe_26"], WHOLE_BODY["halpe_136"]),
}


def with_hands(body: str, first: int, sides: tuple[str, str]) -> str:
    parts = ("hand root", *(f"{finger}{k}" for finger in FINGERS for k in (1, 2, 3, 4)))
    words = [
        f"{first + 21 * hand + i} {side} {part}"
        for hand, side in enumerate(sides)
        for i, part in enumerate(parts)
    ]
    return ", ".join([DOCUMENTED[body], *words])


DOCUMENTED |= {
    "mediapipe_75": with_hands("mediapipe_33", 33, ("right", "left")),
    "body_25_hands": with_hands("body_25", 25, ("left", "right")),
    "coco_18_hands": with_hands("coco_18", 18, ("left", "right")),
}
OUR_WORDS = {
    "Chest": "spine",
    "Nose": "nose",
    "Neck": "neck",
    "MidHip": "mid_hip",
    "BodyCenter": "mid_hip",
    "Hip": "mid_hip",
    "UpperNeck": "upper_neck",
    "HeadTop": "head_top",
    "Head": "head_top",
    "left foot index": "left_big_toe",
    "right foot index": "right_big_toe",
}
PARTS = {
    "Shoulder": "shoulder",
    "Elbow": "elbow",
    "Wrist": "wrist",
    "Hip": "hip",
    "Knee": "knee",
    "Ankle": "ankle",
    "Eye": "eye",
    "Ear": "ear",
    "BigToe": "big_toe",
    "SmallToe": "small_toe",
    "Heel": "heel",
}
SOURCES = {  # of each of the 17 joints, in their order, the detector's joints whose mean it is
    "human36m": [[k] for k in range(17)],
    "coco_17": [
        [16],
        [14],
        [12],
        [11],
        [13],
        [15],
        [11, 12],
        [5, 6, 11, 12],
        [5, 6],
        [1, 2, 3, 4],
        [10],
        [8],
        [6],
        [5],
        [7],
        [9],
        [0],
    ],
    "coco_18": [
        [10],
        [9],
        [8],
        [11],
        [12],
        [13],
        [8, 11],
        [1, 1, 8, 11],
        [1],
        [14, 15, 16, 17],
        [4],
        [3],
        [2],
        [5],
        [6],
        [7],
        [0],
    ],
    "coco_19": [
        [14],
        [13],
        [12],
        [6],
        [7],
        [8],
        [2],
        [0, 2],
        [0],
        [15, 16, 17, 18],
        [11],
        [10],
        [9],
        [3],
        [4],
        [5],
        [1],
    ],
    "body_25": [
        [11],
        [10],
        [9],
        [12],
        [13],
        [14],
        [8],
        [1, 8],
        [1],
        [15, 16, 17, 18],
        [4],
        [3],
        [2],
        [5],
        [6],
        [7],
        [0],
    ],
    "body_25b": [
        [16],
        [14],
        [12],
        [11],
        [13],
        [15],
        [11, 12],
        [5, 6, 11, 12],
        [5, 6],
        [18],
        [10],
        [8],
        [6],
        [5],
        [7],
        [9],
        [0],
    ],
    "halpe_26": [
        [16],
        [14],
        [12],
        [11],
        [13],
        [15],
        [19],
        [18, 19],
        [18],
        [17],
        [10],
        [8],
        [6],
        [5],
        [7],
        [9],
        [0],
    ],
    "mediapipe_33": [
        [28],
        [26],
        [24],
        [23],
        [25],
        [27],
        [23, 24],
        [11, 12, 23, 24],
        [11, 12],
        [2, 5, 7, 8],
        [16],
        [14],
        [12],
        [11],
        [13],
        [15],
        [0],
    ],
}
SOURCES |= {
    "mpii_16": [*([k] for k in range(6)), [6], [6, 7], [7], [9], *([k] for k in range(10, 16)), []],
    "mpi_15": [
        [10],
        [9],
        [8],
        [11],
        [12],
        [13],
        [8, 11],
        [14],
        [1],
        [0],
        [4],
        [3],
        [2],
        [5],
        [6],
        [7],
        [],
    ],
    "coco_133": SOURCES["coco_17"],
    "halpe_136": SOURCES["halpe_26"],
    "mediapipe_75": SOURCES["mediapipe_33"],
    "body_25_hands": SOURCES["body_25"],
    "coco_18_hands": SOURCES["coco_18"],
}


def in_our_words(word: str) -> str:
    """A detector's word in ours, by the two lists above."""
    if word in OUR_WORDS:
        return OUR_WORDS[word]
    if word[0] in "LRlr" and word[1:] in PARTS:
        return f"{'left' if word[0] in 'Ll' else 'right'}_{PARTS[word[1:]]}"
    return word.replace(" ", "_")


def documented(name: str) -> list[tuple[int, str]]:
    entries = [entry.strip().split(" ", 1) for entry in DOCUMENTED[name].split(",")]
    return [(int(index), in_our_words(word)) for index, word in entries]


def test_every_table_has_its_literal():
    assert set(SKELETONS) == set(DOCUMENTED) == set(SOURCES)
    assert list(enumerate(JOINTS)) == documented("human36m")
    assert list(enumerate(COCO19)) == documented("coco_19")


@pytest.mark.parametrize("name", DOCUMENTED)
def test_the_table_is_the_documented_one(name):
    assert list(enumerate(SKELETONS[name])) == documented(name)


@pytest.mark.parametrize("name", SOURCES)
def test_each_of_the_17_joints_comes_from_its_documented_places(name):
    """Points at random, so that no two means are alike."""
    points = np.random.default_rng(0).uniform(0, 1000, (1, 1, len(SKELETONS[name]), 2))
    one = np.ones(points.shape[:3])
    mapped = joints17("x", SKELETONS[name], KeyPoints(points, one, one > 0))
    found = mapped.pixels
    for joint, places in enumerate(SOURCES[name]):
        assert mapped.valid[0, 0, joint] == bool(places)
        if not places:
            continue
        expected = points[0, 0, places].mean(0)
        np.testing.assert_allclose(found[0, 0, joint], expected, rtol=1e-6, err_msg=JOINTS[joint])


def test_panoptic_s_own_map_is_the_documented_one():
    points = np.random.default_rng(0).uniform(0, 1000, (1, 19, 3))
    found = panoptic.joints17(points, np.ones((1, 19), bool))[0]
    for joint, places in enumerate(SOURCES["coco_19"]):
        np.testing.assert_allclose(
            found[0, joint], points[0, places].mean(0), rtol=1e-6, err_msg=JOINTS[joint]
        )


def test_the_body_s_parts_are_the_documented_ones():
    """Of the 17 joints by number: what is mirrored, connected, compared and one of the six."""
    assert MIRROR == (5, 4, 3, 2, 1, 0, 6, 7, 8, 9, 15, 14, 13, 12, 11, 10, 16)
    assert BONES == (
        (0, 1),
        (1, 2),
        (2, 6),
        (5, 4),
        (4, 3),
        (3, 6),
        (6, 7),
        (7, 8),
        (8, 9),
        (9, 16),
        (8, 12),
        (12, 11),
        (11, 10),
        (8, 13),
        (13, 14),
        (14, 15),
    )
    assert SYMMETRIC_BONES == {
        "upper_arm": ((13, 14), (12, 11)),
        "lower_arm": ((14, 15), (11, 10)),
        "shoulder": ((13, 8), (12, 8)),
        "hip": ((3, 6), (2, 6)),
        "upper_leg": ((3, 4), (2, 1)),
        "lower_leg": ((4, 5), (1, 0)),
    }
    assert SIX_JOINTS == (11, 14, 10, 15, 1, 4)


def test_the_words_of_mmpose_s_human36m_are_understood():
    words = (
        "root",
        "right_hip",
        "right_knee",
        "right_foot",
        "left_hip",
        "left_knee",
        "left_foot",
        "spine",
        "thorax",
        "neck_base",
        "head",
        "left_shoulder",
        "left_elbow",
        "left_wrist",
        "right_shoulder",
        "right_elbow",
        "right_wrist",
    )
    ours = (
        "pelvis",
        "right_hip",
        "right_knee",
        "right_ankle",
        "left_hip",
        "left_knee",
        "left_ankle",
        "spine",
        "thorax",
        "nose",
        "head_top",
        "left_shoulder",
        "left_elbow",
        "left_wrist",
        "right_shoulder",
        "right_elbow",
        "right_wrist",
    )
    assert canonical(words) == ours


LINKS = [
    ("nose", "left_eye"),
    ("nose", "right_eye"),
    ("left_shoulder", "right_shoulder"),
    ("left_hip", "right_hip"),
]
for side in ("left", "right"):
    chain = ("eye", "ear", "shoulder", "elbow", "wrist")
    LINKS += [(f"{side}_{a}", f"{side}_{b}") for a, b in pairwise(chain)]
    leg = ("shoulder", "hip", "knee", "ankle", "heel")
    LINKS += [(f"{side}_{a}", f"{side}_{b}") for a, b in pairwise(leg)]
RECORDINGS = {"body_25b": "pose2sim_single/pose", "mediapipe_33": "pose2sim_blazepose/full.npz"}


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_real_standing_person_is_in_order_from_head_to_foot(name, shared_data):
    """In the images of every view, whose y points down."""
    found = read_person(shared_data / RECORDINGS[name])
    assert found.joints == SKELETONS[name]
    place = {word: index for index, word in documented(name)}
    for view in range(4):
        height = {}
        for part in ("eye", "shoulder", "hip", "knee", "ankle"):
            at = [place[f"{side}_{part}"] for side in ("left", "right")]
            height[part] = np.median(found.key_points[:, view, at, 1][found.valid[:, view, at]])
        assert list(height) == sorted(height, key=height.__getitem__)


@pytest.mark.parametrize("name", [*RECORDINGS, "coco_19"])
def test_no_two_joints_of_a_real_person_can_be_exchanged(name, shared_data):
    """The chains of neighbours are longer, in sum, with any two joints exchanged."""
    points = real_people(name, shared_data)
    place = {word: index for index, word in enumerate(SKELETONS[name])}
    links = [(place[a], place[b]) for a, b in LINKS if a in place and b in place]
    own = chain_length(points, links)
    linked = sorted({joint for link in links for joint in link})
    for a, b in combinations(linked, 2):
        swap = {a: b, b: a}
        other = chain_length(points, [(swap.get(i, i), swap.get(j, j)) for i, j in links])
        assert other > own, f"{SKELETONS[name][a]} and {SKELETONS[name][b]}"


def real_people(name: str, data) -> np.ndarray:
    """Frames x joints x 2 or 3; NaN where not seen."""
    if name == "coco_19":
        with np.load(data / "panoptic" / "171026_pose3_joints19.npz") as stored:
            return stored["poses"][::50]
    found = read_person(data / RECORDINGS[name])
    points = np.where(found.valid[..., None], found.key_points, np.nan)
    return points.reshape(-1, *points.shape[2:])


def chain_length(points: np.ndarray, links: list[tuple[int, int]]) -> float:
    a, b = np.array(links).T
    return float(np.nanmean(np.linalg.norm(points[:, a] - points[:, b], axis=-1)))
