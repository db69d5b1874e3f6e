"""Skeletons: what a detector's key points are called, and the 17 joints of Human3.6M among them.

The paper's data sets, the learned scorer and the calibration have the 17 joints on their J axis, in
the order of ``JOINTS``. What is predicted has those of the detector's own `Skeleton`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from ghpt.errors import GhptDataError

JOINTS = (
    "right_ankle",
    "right_knee",
    "right_hip",
    "left_hip",
    "left_knee",
    "left_ankle",
    "pelvis",
    "spine",
    "thorax",
    "head_top",
    "right_wrist",
    "right_elbow",
    "right_shoulder",
    "left_shoulder",
    "left_elbow",
    "left_wrist",
    "nose",
)
"""Pelvis is the middle of the hips, thorax the base of the neck. Right comes before left: the
authors' code names index 0 the left foot, but projecting Human3.6M into its images shows the right
one.
"""

JOINT = {name: index for index, name in enumerate(JOINTS)}
"""Index on the J axis by name."""


def _bone(start: str, end: str) -> tuple[int, int]:
    return JOINT[start], JOINT[end]


BONES = (
    _bone("right_ankle", "right_knee"),
    _bone("right_knee", "right_hip"),
    _bone("right_hip", "pelvis"),
    _bone("left_ankle", "left_knee"),
    _bone("left_knee", "left_hip"),
    _bone("left_hip", "pelvis"),
    _bone("pelvis", "spine"),
    _bone("spine", "thorax"),
    _bone("thorax", "head_top"),
    _bone("head_top", "nose"),
    _bone("thorax", "right_shoulder"),
    _bone("right_shoulder", "right_elbow"),
    _bone("right_elbow", "right_wrist"),
    _bone("thorax", "left_shoulder"),
    _bone("left_shoulder", "left_elbow"),
    _bone("left_elbow", "left_wrist"),
)
"""The 16 bones between adjacent joints (paper, section 3.1), as index pairs."""

SYMMETRIC_BONES = {
    "upper_arm": (_bone("left_shoulder", "left_elbow"), _bone("right_shoulder", "right_elbow")),
    "lower_arm": (_bone("left_elbow", "left_wrist"), _bone("right_elbow", "right_wrist")),
    "shoulder": (_bone("left_shoulder", "thorax"), _bone("right_shoulder", "thorax")),
    "hip": (_bone("left_hip", "pelvis"), _bone("right_hip", "pelvis")),
    "upper_leg": (_bone("left_hip", "left_knee"), _bone("right_hip", "right_knee")),
    "lower_leg": (_bone("left_knee", "left_ankle"), _bone("right_knee", "right_ankle")),
}
"""The six (left, right) pairs of bones of the pose prior (paper, section 4.4), by name."""


def _mirror(name: str) -> str:
    other = {"left": "right", "right": "left"}
    return "_".join(other.get(word, word) for word in name.split("_"))


MIRROR = tuple(JOINT[_mirror(name)] for name in JOINTS)
"""For each joint, the joint on the other side of the body (itself on the midline)."""

SIX_JOINTS = (
    JOINT["right_elbow"],
    JOINT["left_elbow"],
    JOINT["right_wrist"],
    JOINT["left_wrist"],
    JOINT["right_knee"],
    JOINT["left_knee"],
)
"""Elbows, wrists and knees: the joints on which Iskakov et al. report CMU -> Human3.6M."""

PELVIS = JOINT["pelvis"]
THORAX = JOINT["thorax"]


NamePair = tuple[str, str]

_MEANS: Mapping[str, tuple[tuple[str, ...], ...]] = {
    "pelvis": (("mid_hip",), ("left_hip", "right_hip")),
    "thorax": (("neck",), ("left_shoulder", "right_shoulder")),
    "head_top": (("left_eye", "right_eye", "left_ear", "right_ear"),),
    "spine": (("pelvis", "thorax"),),
}
"""The means that may stand for a joint that a detector lacks; the first that it has is taken."""

_LEAST_JOINTS = 8
"""Of the 17; with fewer, what is known of people says too little."""


@dataclass(frozen=True)
class Skeleton:
    """The K key points of a detector, in its order, and what is known of them."""

    name: str
    key_points: tuple[str, ...]
    bones: tuple[tuple[int, int], ...]
    """Index pairs of key points whose distance hardly changes."""
    pairs: tuple[tuple[int, int], ...]
    """Index pairs (left, right); the other key points are on the midline."""
    joints: tuple[tuple[float, ...], ...]
    """[17 K]: each of the 17 joints as a weighted mean of key points. The weights are at least 0
    and sum to 1; a joint that the detector cannot give has zeros.
    """

    def __len__(self) -> int:
        return len(self.key_points)

    @property
    def bone_names(self) -> tuple[NamePair, ...]:
        """The bones, by the names of their ends."""
        names = self.key_points
        return tuple((names[start], names[end]) for start, end in self.bones)

    @cached_property
    def mirror(self) -> tuple[int, ...]:
        """For each key point, the one on the other side of the body."""
        order = list(range(len(self)))
        for left, right in self.pairs:
            order[left] = right
            order[right] = left
        return tuple(order)

    @cached_property
    def joint_weights(self) -> Float[np.ndarray, "17 K"]:
        """``joints`` as an array."""
        return np.array(self.joints).reshape(len(JOINTS), len(self))

    @cached_property
    def missing_joints(self) -> tuple[str, ...]:
        """The names of those of the 17 joints that the key points do not give."""
        rows = zip(JOINTS, self.joints, strict=True)
        return tuple(name for name, weights in rows if not any(weights))

    def select(self, chosen: Sequence[int]) -> Skeleton:
        """Return the skeleton of some of the key points, in this order."""
        place = {key_point: i for i, key_point in enumerate(chosen)}
        bones = [bone for bone in self.bones if place.keys() >= set(bone)]
        pairs = [pair for pair in self.pairs if place.keys() >= set(pair)]
        rows = [row if _uses_only(row, place) else (0.0,) * len(self) for row in self.joints]
        return Skeleton(
            name=self.name,
            key_points=tuple(self.key_points[i] for i in chosen),
            bones=tuple((place[start], place[end]) for start, end in bones),
            pairs=tuple((place[left], place[right]) for left, right in pairs),
            joints=tuple(tuple(row[i] for i in chosen) for row in rows),
        )

    @property
    def has_joints(self) -> bool:
        """Whether the key points give enough of the 17 joints."""
        return len(JOINTS) - len(self.missing_joints) >= _LEAST_JOINTS

    def require_joints(self, where: object) -> None:
        """Raise GhptDataError, for the file ``where``, unless ``has_joints``."""
        if not self.has_joints:
            problem = f"lack {', '.join(self.missing_joints)}"
            known = ", ".join(JOINTS)
            hint = f"Name them as the 17 ({known}), or say in a yaml how these are made: skeleton=."
            raise GhptDataError(where, "joints", problem, hint)


def make_skeleton(
    where: object,
    name: str,
    key_points: Sequence[str],
    bones: Sequence[Sequence[str]] | None = None,
    pairs: Sequence[Sequence[str]] = (),
    joints: Mapping[str, Mapping[str, float]] | None = None,
) -> Skeleton:
    """Return a skeleton whose parts are given by the names of key points.

    ``bones``: each a chain of two names or more; None: those of ``HUMAN_BONES`` that are there.
    ``pairs``: (left, right), beside those whose names differ in left and right alone. ``joints``:
    those of the 17 that are not what their name says, or are a mean that ``_MEANS`` does not know,
    as weights of key points, which are scaled to the sum of 1.

    Raises GhptDataError, for the file ``where``, for a name that is there twice, one that is no key
    point, and weights that give no mean.
    """
    index = {key_point: place for place, key_point in enumerate(key_points)}
    if len(index) != len(key_points):
        twice = next(one for one in key_points if list(key_points).count(one) > 1)
        hint = "Name each key point once."
        raise GhptDataError(where, "key_points", f"{twice} is there twice", hint)
    if bones is None:
        bones = [bone for bone in HUMAN_BONES if index.keys() >= set(bone)]
    named = [(key_point, _mirror(key_point)) for key_point in key_points if _is_left(key_point)]
    named = [pair for pair in named if pair[1] in index]
    chains = [_indices(where, "bones", index, chain) for chain in bones]
    sides = [_indices(where, "pairs", index, pair) for pair in (*named, *pairs)]
    paired = [key_point for side in sides for key_point in side]
    if any(len(side) != 2 for side in sides) or len(set(paired)) != len(paired):
        hint = "Give each key point once: [left, right]."
        raise GhptDataError(where, "pairs", "are no pairs of different key points", hint)
    return Skeleton(
        name=name,
        key_points=tuple(key_points),
        bones=tuple(bone for chain in chains for bone in pairwise(chain)),
        pairs=tuple((left, right) for left, right in sides),
        joints=_joint_weights(where, index, joints or {}),
    )


def _uses_only(weights: Sequence[float], places: Mapping[int, int]) -> bool:
    return all(place in places for place, weight in enumerate(weights) if weight)


def _is_left(name: str) -> bool:
    return "left" in name.split("_")


def _indices(
    where: object, field: str, index: Mapping[str, int], names: Sequence[str]
) -> tuple[int, ...]:
    unknown = [name for name in names if name not in index]
    if unknown or len(set(names)) != len(names):
        problem = f"{', '.join(names)} names one twice"
        if unknown:
            problem = f"{unknown[0]} is no key point"
        raise GhptDataError(where, field, problem, f"The key points are {', '.join(index)}.")
    return tuple(index[name] for name in names)


def _joint_weights(
    where: object, index: Mapping[str, int], given: Mapping[str, Mapping[str, float]]
) -> tuple[tuple[float, ...], ...]:
    """Return the rows of ``Skeleton.joints``."""
    known = {name: _unit_row(len(index), place) for name, place in index.items()}
    for joint, weights in given.items():
        if joint not in JOINT:
            hint = f"The 17 are {', '.join(JOINTS)}."
            raise GhptDataError(where, "joints", f"{joint} is none of the 17", hint)
        _indices(where, f"joints.{joint}", index, list(weights))
        total = sum(weights.values())
        if not total > 0 or min(weights.values()) < 0:
            hint = "Give weights of at least 0, one of them more."
            raise GhptDataError(where, f"joints.{joint}", "is no weighted mean", hint)
        known[joint] = _mean([known[part] for part in weights], list(weights.values()))
    for joint, choices in _MEANS.items():
        parts = next((parts for parts in choices if known.keys() >= set(parts)), ())
        if joint not in known and parts:
            known[joint] = _mean([known[part] for part in parts], [1.0] * len(parts))
    nothing = (0.0,) * len(index)
    return tuple(known.get(joint, nothing) for joint in JOINTS)


def _unit_row(count: int, place: int) -> tuple[float, ...]:
    return tuple(float(column == place) for column in range(count))


def _mean(rows: Sequence[tuple[float, ...]], weights: Sequence[float]) -> tuple[float, ...]:
    total = sum(weights)
    columns = zip(*rows, strict=True)
    return tuple(
        sum(weight * value for weight, value in zip(weights, column, strict=True)) / total
        for column in columns
    )


FINGERS = ("thumb", "forefinger", "middle_finger", "ring_finger", "pinky_finger")
"""Of a hand, by COCO-WholeBody's names; each has four points from its root on."""


def _knuckles(finger: str) -> list[str]:
    return [f"{finger}{number}" for number in range(1, 5)]


def hand_points(side: str) -> tuple[str, ...]:
    """Return the 21 points of a hand, in the order that OpenPose, MediaPipe and COCO share."""
    fingers = [point for finger in FINGERS for point in _knuckles(finger)]
    return tuple(f"{side}_{point}" for point in ("hand_root", *fingers))


def _both_sides(*chain: str) -> tuple[NamePair, ...]:
    """Return the bones of a chain on the left and on the right of the body."""
    bones = pairwise(chain)
    sided = [(f"left_{start}", f"left_{end}") for start, end in bones]
    return (*sided, *((_mirror(start), _mirror(end)) for start, end in sided))


HUMAN_BONES: tuple[NamePair, ...] = (
    *((JOINTS[start], JOINTS[end]) for start, end in BONES),
    *_both_sides("eye", "ear"),
    ("nose", "left_eye"),
    ("nose", "right_eye"),
    *_both_sides("shoulder", "hip"),
    ("left_shoulder", "right_shoulder"),
    ("left_hip", "right_hip"),
    ("neck", "left_shoulder"),
    ("neck", "right_shoulder"),
    ("neck", "head_top"),
    ("neck", "nose"),
    ("mid_hip", "left_hip"),
    ("mid_hip", "right_hip"),
    ("mid_hip", "neck"),
    *_both_sides("ankle", "heel", "big_toe"),
    *_both_sides("heel", "small_toe"),
    *_both_sides("wrist", "index"),
    *_both_sides("wrist", "pinky"),
    *_both_sides("wrist", "thumb"),
    *_both_sides("wrist", "hand_root"),
    *(bone for finger in FINGERS for bone in _both_sides("hand_root", *_knuckles(finger))),
)
"""Bones between the key points of people by name, whichever of them a detector has."""

HUMAN36M = make_skeleton(
    "ghpt.skeleton",
    "human36m",
    JOINTS,
    bones=[(JOINTS[start], JOINTS[end]) for start, end in BONES],
)
"""The 17 joints as a skeleton of their own."""
