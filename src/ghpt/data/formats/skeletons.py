"""The skeletons of common 2D detectors, by joint name, and their map to the project's 17 joints."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from ghpt.data.datasets.panoptic import COCO19
from ghpt.data.points import KeyPoints
from ghpt.errors import GhptDataError
from ghpt.skeleton import JOINTS


def _sides(*names: str) -> tuple[str, ...]:
    return tuple(f"{side}_{name}" for name in names for side in ("left", "right"))


_LIMBS = _sides("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
_FEET = ("big_toe", "small_toe", "heel")
_COCO_17 = ("nose", *_sides("eye", "ear"), *_LIMBS)
_OPENPOSE_BODY = (
    "nose",
    "neck",
    "right_shoulder",
    "right_elbow",
    "right_wrist",
    "left_shoulder",
    "left_elbow",
    "left_wrist",
)
_OPENPOSE_LEGS = ("right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle")
_OPENPOSE_HEAD = ("right_eye", "left_eye", "right_ear", "left_ear")
_LEFT_FOOT_FIRST = tuple(f"{side}_{part}" for side in ("left", "right") for part in _FEET)

SKELETONS: dict[str, tuple[str, ...]] = {
    "human36m": JOINTS,
    "coco_17": _COCO_17,
    "coco_18": (*_OPENPOSE_BODY, *_OPENPOSE_LEGS, *_OPENPOSE_HEAD),
    "coco_19": COCO19,
    "body_25": (*_OPENPOSE_BODY, "mid_hip", *_OPENPOSE_LEGS, *_OPENPOSE_HEAD, *_LEFT_FOOT_FIRST),
    "body_25b": (*_COCO_17, "upper_neck", "head_top", *_LEFT_FOOT_FIRST),
    "halpe_26": (*_COCO_17, "head_top", "neck", "mid_hip", *_sides(*_FEET)),
    "mediapipe_33": (
        "nose",
        "left_eye_inner",
        "left_eye",
        "left_eye_outer",
        "right_eye_inner",
        "right_eye",
        "right_eye_outer",
        "left_ear",
        "right_ear",
        "mouth_left",
        "mouth_right",
        *_sides(
            "shoulder",
            "elbow",
            "wrist",
            "pinky",
            "index",
            "thumb",
            "hip",
            "knee",
            "ankle",
            "heel",
            "big_toe",
        ),
    ),
}
"""Joints in the detector's order, in the words of ``ghpt.skeleton``. ``coco_19`` is CMU Panoptic's.
"""

_SOURCES: dict[str, tuple[tuple[str, ...], ...]] = {joint: ((joint,),) for joint in JOINTS} | {
    "pelvis": (("pelvis",), ("mid_hip",), ("left_hip", "right_hip")),
    "thorax": (("thorax",), ("neck",), ("left_shoulder", "right_shoulder")),
    "head_top": (("head_top",), ("left_eye", "right_eye", "left_ear", "right_ear")),
}
"""The means that may stand for a joint; the first whose parts the skeleton has is taken."""

_BONES = (
    ("nose", "left_eye"),
    ("nose", "right_eye"),
    *(
        (f"{side}_{a}", f"{side}_{b}")
        for side in ("left", "right")
        for a, b in (
            ("shoulder", "elbow"),
            ("elbow", "wrist"),
            ("shoulder", "hip"),
            ("hip", "knee"),
            ("knee", "ankle"),
            ("eye", "ear"),
            ("ankle", "heel"),
            ("heel", "big_toe"),
        )
    ),
)
_CLEARLY = 0.8
"""A skeleton is told from another when its bones have less than this part of the other's length."""


def joints_of(where: object, skeleton: str) -> tuple[str, ...]:
    """Return the joints of a skeleton by name. Raises GhptDataError for one that is not known."""
    name = skeleton.lower().replace("-", "_")
    if name not in SKELETONS:
        problem = f"there is no skeleton {skeleton!r}"
        raise GhptDataError(where, "skeleton", problem, f"Choose from {', '.join(SKELETONS)}.")
    return SKELETONS[name]


def parts_of(where: object, joints: Sequence[str]) -> list[tuple[str, ...]]:
    """Return for each of the 17 joints the detector's joints whose mean it is.

    It is () where the detector has none.

    Raises GhptDataError if a detector's joint is there twice or fewer than 8 of the 17 joints can
    be had.
    """
    if len(set(joints)) != len(joints):
        twice = next(name for name in joints if list(joints).count(name) > 1)
        raise GhptDataError(where, "joints", f"{twice} is there twice", "Name each joint once.")
    found = {}
    for joint, choices in _SOURCES.items():
        found[joint] = next((parts for parts in choices if set(parts) <= set(joints)), ())
    if "spine" not in joints and found["pelvis"] and found["thorax"]:
        found["spine"] = ("pelvis", "thorax")
    missing = [joint for joint in JOINTS if not found[joint]]
    if len(missing) > 9:
        hint = f"Name the joints as in {', '.join(SKELETONS)}; the 17 are {', '.join(JOINTS)}."
        raise GhptDataError(where, "joints", f"lack {', '.join(missing)}", hint)
    return [found[joint] for joint in JOINTS]


def joints17(where: object, joints: Sequence[str], points: KeyPoints) -> KeyPoints:
    """Map any skeleton's undistorted key points to the 17 joints, float32.

    A joint that is a mean of others is valid where all of them are and has the least of their
    confidences; a joint that the detector does not have is never valid.
    """
    index = {name: i for i, name in enumerate(joints)}
    shape = (*points.valid.shape[:-1], len(JOINTS))
    pixels = np.zeros((*shape, 2), np.float32)
    confidence = np.zeros(shape, np.float32)
    valid = np.zeros(shape, np.bool_)
    parts = parts_of(where, joints)
    for joint, names in enumerate(parts):
        if not names or not set(names) <= set(index):
            continue
        chosen = [index[name] for name in names]
        valid[..., joint] = points.valid[..., chosen].all(-1)
        confidence[..., joint] = points.confidence[..., chosen].min(-1)
        pixels[..., joint, :] = points.pixels[..., chosen, :].mean(-2)
    spine = JOINTS.index("spine")
    if parts[spine] == ("pelvis", "thorax"):
        ends = [JOINTS.index(name) for name in parts[spine]]
        valid[..., spine] = valid[..., ends].all(-1)
        confidence[..., spine] = confidence[..., ends].min(-1)
        pixels[..., spine, :] = pixels[..., ends, :].mean(-2)
    pixels = np.where(valid[..., None], pixels, 0)
    return KeyPoints(pixels, np.where(valid, confidence, 0), valid)


def recognise(
    where: object, key_points: Float[np.ndarray, "N K 2"], valid: Bool[np.ndarray, "N K"]
) -> str:
    """Return the name of the skeleton of N people.

    Of those with K joints it is the one whose bones are shortest in the images.

    Raises GhptDataError if none has K joints, or if two of them are as good.
    """
    count = key_points.shape[1]
    choices = [name for name, joints in SKELETONS.items() if len(joints) == count]
    if not choices:
        known = ", ".join(f"{name} ({len(joints)})" for name, joints in SKELETONS.items())
        problem = f"no known skeleton has {count} joints"
        raise GhptDataError(where, "skeleton", problem, f"Known: {known}.")
    if len(choices) == 1:
        return choices[0]
    lengths = sorted((_bone_length(SKELETONS[name], key_points, valid), name) for name in choices)
    (shortest, name) = lengths[0]
    (second, other) = lengths[1]
    if not shortest < _CLEARLY * second:
        problem = f"it may be {name} or {other}: both have {count} joints"
        raise GhptDataError(where, "skeleton", problem, f"Name it: skeleton={name}.")
    return name


def _bone_length(joints: tuple[str, ...], key_points: np.ndarray, valid: np.ndarray) -> float:
    """Return the mean over the bones of their median length, pixels; inf if none is ever valid."""
    bones = [(a, b) for a, b in _BONES if a in joints and b in joints]
    starts = [joints.index(a) for a, _ in bones]
    ends = [joints.index(b) for _, b in bones]
    length = np.linalg.norm(key_points[:, starts] - key_points[:, ends], axis=-1)
    length = np.where(valid[:, starts] & valid[:, ends], length, np.nan)
    measured = ~np.isnan(length).all(0)
    if not measured.any():
        return np.inf
    return float(np.nanmedian(length[:, measured], axis=0).mean())


_OTHER_WORDS = {
    "root": "pelvis",
    "hip": "mid_hip",
    "hip_center": "mid_hip",
    "neck_base": "neck",
    "head": "head_top",
    "top_head": "head_top",
    "right_foot": "right_ankle",
    "left_foot": "left_ankle",
}


def canonical(names: Sequence[str]) -> tuple[str, ...]:
    """Return a file's own names of joints in the words of ``SKELETONS``.

    ``Left Elbow``, ``LElbow`` and ``leftElbow`` are ``left_elbow``; what is not known stays as it
    is. MMPose's ``h36m`` calls the nose the base of the neck.
    """
    found = tuple(_canonical(name) for name in names)
    if "thorax" in found and "nose" not in found:
        return tuple("nose" if name == "neck" else name for name in found)
    return found


def _canonical(name: str) -> str:
    word = _WORD_BORDER.sub("_", name.strip()).lower()
    word = re.sub(r"^r_", "right_", word)
    word = re.sub(r"^l_", "left_", word)
    side_last = re.fullmatch(r"(.+)_(left|right|l|r)", word)
    if side_last:
        part, side = side_last.groups()
        word = f"{_SIDES.get(side, side)}_{part}"
    return _OTHER_WORDS.get(word, word)


_SIDES = {"l": "left", "r": "right"}
_WORD_BORDER = re.compile(r"(?<=[a-z])(?=[A-Z])|(?<=^[LR])(?=[A-Z][a-z])|[ .-]+")
