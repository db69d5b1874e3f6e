"""The skeletons of common 2D detectors, by name, and their map to the project's 17 joints."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from ghpt.config import CONF, read_yaml, settings
from ghpt.data.points import KeyPoints
from ghpt.errors import GhptConfigError, GhptDataError
from ghpt.skeleton import JOINTS, Skeleton, make_skeleton

_FOLDER = CONF / "skeletons"
_SUFFIXES = (".yaml", ".yml")
_HINT = "See docs/skeletons.md for what the file holds."


@dataclass(frozen=True)
class SkeletonFile:
    """What the yaml of a skeleton holds; see `make_skeleton`."""

    key_points: list[str]
    bones: list[list[str]] | None = None
    pairs: list[list[str]] = field(default_factory=list)
    joints: dict[str, dict[str, float]] = field(default_factory=dict)


def read_skeleton(path: Path) -> Skeleton:
    """Return the skeleton of a yaml, named as the file is.

    Raises GhptConfigError for a file that cannot be read and GhptDataError for one that is no
    skeleton.
    """
    content = read_yaml(path, "skeleton")
    try:
        file = settings(SkeletonFile, content)
    except GhptConfigError as error:
        raise GhptDataError(path, error.key, error.problem, f"{error.hint} {_HINT}") from error
    return make_skeleton(path, path.stem, file.key_points, file.bones, file.pairs, file.joints)


@cache
def _known_skeletons() -> dict[str, Skeleton]:
    return {path.stem: read_skeleton(path) for path in sorted(_FOLDER.glob("*.yaml"))}


SKELETONS: dict[str, tuple[str, ...]] = {
    name: skeleton.key_points for name, skeleton in _known_skeletons().items()
}
"""The key points of the known skeletons in the detector's order. ``coco_19`` is CMU Panoptic's."""

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


def find_skeleton(where: object, skeleton: str) -> Skeleton:
    """Return a known skeleton by name, or the one of a yaml by path.

    Raises GhptDataError, for the key points ``where``, for a name that is not known, and for a
    file that holds no skeleton.
    """
    if skeleton.lower().endswith(_SUFFIXES):
        return read_skeleton(Path(skeleton))
    name = skeleton.lower().replace("-", "_")
    known = _known_skeletons()
    if name not in known:
        problem = f"there is no skeleton {skeleton!r}"
        hint = f"Choose from {', '.join(known)}, or name a yaml of your own."
        raise GhptDataError(where, "skeleton", problem, hint)
    return known[name]


def joints_of(where: object, skeleton: str) -> tuple[str, ...]:
    """Return the key points of a skeleton by name; see `find_skeleton`."""
    return find_skeleton(where, skeleton).key_points


def skeleton_of(where: object, key_points: Sequence[str]) -> Skeleton:
    """Return the skeleton that has these key points in this order.

    Without a known one it is what their names tell. Raises GhptDataError for a name that is there
    twice.
    """
    for skeleton in _known_skeletons().values():
        if skeleton.key_points == tuple(key_points):
            return skeleton
    return make_skeleton(where, "own", key_points)


def joints17(where: object, joints: Sequence[str], points: KeyPoints) -> KeyPoints:
    """Map any skeleton's undistorted key points to the 17 joints, float32.

    A joint that is a mean of others is valid where all of them are and has the least of their
    confidences; a joint that the detector does not have is never valid.
    """
    return map_to_joints(points, skeleton_of(where, joints))


def map_to_joints(points: KeyPoints, skeleton: Skeleton) -> KeyPoints:
    """Map a skeleton's undistorted key points to the 17 joints, as `joints17` says."""
    shape = (*points.valid.shape[:-1], len(JOINTS))
    pixels = np.zeros((*shape, 2), np.float32)
    confidence = np.zeros(shape, np.float32)
    valid = np.zeros(shape, np.bool_)
    for joint, weights in enumerate(skeleton.joint_weights):
        parts = np.flatnonzero(weights)
        if not len(parts):
            continue
        valid[..., joint] = points.valid[..., parts].all(-1)
        confidence[..., joint] = points.confidence[..., parts].min(-1)
        mean = (weights[parts, None] * points.pixels[..., parts, :]).sum(-2)
        pixels[..., joint, :] = mean
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
