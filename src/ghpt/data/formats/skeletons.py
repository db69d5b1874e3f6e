"""The skeletons of common 2D detectors, by name, and their map to the project's 17 joints."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from ghpt.config import CONF, read_yaml, settings, suggest
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

_BONES: dict[tuple[str, str], float] = {
    ("shoulder", "elbow"): 0.186,
    ("elbow", "wrist"): 0.146,
    ("shoulder", "hip"): 0.288,
    ("hip", "knee"): 0.245,
    ("knee", "ankle"): 0.246,
    ("eye", "ear"): 0.045,
    ("ankle", "heel"): 0.040,
    ("heel", "big_toe"): 0.130,
}
"""Bones of each side, in statures (Drillis and Contini 1966; head and foot by the body model)."""
_MIDDLE_BONES: dict[tuple[str, str], float] = {
    ("left_shoulder", "right_shoulder"): 0.200,
    ("left_hip", "right_hip"): 0.130,
    ("nose", "left_eye"): 0.025,
    ("nose", "right_eye"): 0.025,
}
_TYPICAL = _MIDDLE_BONES | {
    (f"{side}_{a}", f"{side}_{b}"): length
    for (a, b), length in _BONES.items()
    for side in ("left", "right")
}
_FULL_LENGTH = 0.8
"""The quantile over people of a bone's length in the images: most of them foreshorten it."""
_LEAST_SPREAD = 1e-3
_CLEARLY = 0.7
"""A skeleton is told from another when it misfits people at most so many times as the other."""


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
        hint = f"{suggest(name, known)} Or name a yaml of your own."
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

    Of those with K joints it is the one whose bones, of those that both of two skeletons have, are
    shorter in the images and more like a person's in their proportions.

    Raises GhptDataError if none has K joints, or if two of them are as good.
    """
    count = key_points.shape[1]
    choices = {name: joints for name, joints in SKELETONS.items() if len(joints) == count}
    if not choices:
        raise _unknown(where, f"no known skeleton has {count} joints")
    return _best_fit(where, choices, key_points, valid)


def recognise_beginning(
    where: object, key_points: Float[np.ndarray, "N K 2"], valid: Bool[np.ndarray, "N K"]
) -> str:
    """Return the name of the skeleton of N people of whom the last key points may be missing.

    It is one of K key points, unless one of more fits clearly better. Raises GhptDataError as
    `recognise`.
    """
    count = key_points.shape[1]
    by_beginning: dict[tuple[str, ...], str] = {}
    for name, joints in sorted(SKELETONS.items(), key=lambda item: len(item[1])):
        if len(joints) >= count:
            by_beginning.setdefault(joints[:count], name)
    choices = {name: joints for joints, name in by_beginning.items()}
    same = {name: joints for name, joints in choices.items() if len(SKELETONS[name]) == count}
    if not choices:
        raise _unknown(where, f"no known skeleton has {count} joints or more")
    best = _best_fit(where, same or choices, key_points, valid)
    for name, joints in choices.items():
        if _misfit(joints, choices[best], key_points, valid) < _CLEARLY:
            best = name
    return best


def _unknown(where: object, problem: str) -> GhptDataError:
    known = ", ".join(f"{name} ({len(joints)})" for name, joints in SKELETONS.items())
    return GhptDataError(where, "skeleton", problem, f"Known: {known}.")


def _best_fit(
    where: object, choices: dict[str, tuple[str, ...]], key_points: np.ndarray, valid: np.ndarray
) -> str:
    """Return the name of the choice that fits people clearly best. Raises GhptDataError."""
    best, *others = choices
    for other in others:
        if _misfit(choices[other], choices[best], key_points, valid) < 1:
            best = other
    for other, joints in choices.items():
        if other != best and not _misfit(choices[best], joints, key_points, valid) < _CLEARLY:
            problem = f"it may be {best} or {other}: {len(joints)} joints fit both"
            raise GhptDataError(where, "skeleton", problem, f"Name it: skeleton={best}.")
    return best


def _misfit(
    own: tuple[str, ...], its: tuple[str, ...], key_points: np.ndarray, valid: np.ndarray
) -> float:
    """Return how many times as badly as another skeleton the first fits people; NaN if unknown."""
    bones = [bone for bone in _TYPICAL if {*bone} <= {*own} and {*bone} <= {*its}]
    if not bones:
        return np.nan
    lengths = [_bone_lengths(joints, bones, key_points, valid) for joints in (own, its)]
    measured = np.isfinite(lengths).all(0)
    if measured.sum() < 2:
        return np.nan
    typical = np.log([_TYPICAL[bone] for bone in bones])[measured]
    misfits = []
    for length in lengths:
        found = length[measured]
        spread = (np.log(found) - typical).std()
        misfits.append(float(found.mean() * max(spread, _LEAST_SPREAD)))
    return misfits[0] / misfits[1]


def _bone_lengths(
    joints: tuple[str, ...], bones: Sequence[tuple[str, str]], pixels: np.ndarray, valid: np.ndarray
) -> Float[np.ndarray, " B"]:
    """Return each bone's full length in the images, pixels; NaN if it is never valid."""
    lengths = []
    for start, end in bones:
        a = joints.index(start)
        b = joints.index(end)
        both = valid[:, a] & valid[:, b]
        found = np.linalg.norm(pixels[both, a] - pixels[both, b], axis=-1)
        lengths.append(np.quantile(found, _FULL_LENGTH).clip(1e-6) if len(found) else np.nan)
    return np.array(lengths)


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
