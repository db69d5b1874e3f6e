"""OpenPose's layout: a folder for each camera, with a JSON file for each frame."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from ghpt.data.validate import read_json
from ghpt.errors import GhptDataError

_LAYOUT = "It must hold a folder for each camera, each with a JSON file for each frame: cam1/cam1_000000000012.json."
_MOST_FILES = 2_000_000
_MOST_PEOPLE = 64
"""In a view of a frame; more are no people."""
_JUMP = 2.0
"""How much of a person's quality (at most 1) a jump by their own size costs."""

People = list[Float[np.ndarray, "_ K 3"]]
"""For each frame the people in it: x, y, confidence of their joints; pixels."""


def camera_folders(root: Path) -> list[Path]:
    """The folders that hold JSON files, by name. Raises GhptDataError if there is none."""
    folders = [f for f in sorted(root.iterdir()) if f.is_dir() and any(f.glob("*.json"))] if root.is_dir() else []
    if not folders:
        mend = "Name the folder above." if root.is_dir() and any(root.glob("*.json")) else _LAYOUT
        raise GhptDataError(root, "", "holds no folder with OpenPose's JSON files", mend)
    return folders


def read_people(folder: Path) -> tuple[Int[np.ndarray, " T"], People]:
    """One camera's frame numbers, in order, and the people of each; all have the same number of joints.

    The frame number is the last number in the file's name, so a file that is missing shifts nothing. Raises
    GhptDataError for a name without a number, a number that is there twice, and a damaged file.
    """
    files: dict[int, Path] = {}
    for path in sorted(folder.glob("*.json")):
        digits = re.findall(r"\d+", path.stem)
        if not digits or len(digits[-1]) > 15:
            raise GhptDataError(path, "", "its name has no frame number", "Name the files like cam1_000012.json.")
        number = int(digits[-1])
        if number in files:
            problem = f"has the frame number {number}, as {files[number].name} has"
            raise GhptDataError(path, "", problem, "Keep one file for each frame.")
        files[number] = path
    if len(files) > _MOST_FILES:
        raise GhptDataError(folder, "", f"holds {len(files)} files", f"At most {_MOST_FILES} are read.")
    frames = sorted(files)
    people: People = []
    joints = 0
    for frame in frames:
        found = _people(files[frame])
        if found.shape[0]:
            if joints not in (0, found.shape[1]):
                problem = f"has people of {found.shape[1]} joints, the files before of {joints}"
                raise GhptDataError(files[frame], "people", problem, "Detect all frames with one model.")
            joints = found.shape[1]
        people.append(found)
    return np.array(frames, np.int64), [p if len(p) else np.zeros((0, joints, 3)) for p in people]


def _people(path: Path) -> Float[np.ndarray, "P K 3"]:
    content = read_json(path)
    people = content.get("people") if isinstance(content, dict) else None
    if not isinstance(people, list) or not all(isinstance(person, dict) for person in people):
        raise GhptDataError(path, "people", "is not a list of people", "This must be a file that OpenPose wrote.")
    if len(people) > _MOST_PEOPLE:
        raise GhptDataError(path, "people", f"{len(people)} are listed", f"At most {_MOST_PEOPLE} are read.")
    found = [_joints(path, index, person) for index, person in enumerate(people)]
    found = [person for person in found if len(person)]
    if len({person.shape for person in found}) > 1:
        raise GhptDataError(path, "people", "do not have the same number of joints", "Detect them with one model.")
    return np.stack(found) if found else np.zeros((0, 0, 3))


def _joints(path: Path, index: int, person: dict[str, Any]) -> Float[np.ndarray, "K 3"]:
    field = f"people[{index}].pose_keypoints_2d"
    flat = person.get("pose_keypoints_2d")
    if not isinstance(flat, list) or len(flat) % 3 or not all(type(x) in (int, float) for x in flat):
        raise GhptDataError(path, field, "is not a list of x, y, confidence", "Detect this frame again.")
    joints = np.array([min(max(x, -1e300), 1e300) for x in flat], dtype=np.float64).reshape(-1, 3)
    if not (np.abs(joints) < 1e6).all():
        raise GhptDataError(path, field, "holds a number beyond 1e6", "Detect this frame again.")
    return joints


def seen_joints(people: Float[np.ndarray, "*B K 3"]) -> Bool[np.ndarray, "*B K"]:
    """Which joints were found: OpenPose writes 0, 0, 0 for the others; a confidence of 0 or less counts as that."""
    return people[..., 2] > 0


def follow(people: People) -> Int[np.ndarray, " T"]:
    """For each frame the index of the one person that is followed through it, -1 where there is nobody.

    Of all ways to choose one person in each frame, the one with the greatest sum of qualities less jumps
    (Viterbi). The quality of a person is their size times their mean confidence over that of the best in this view;
    a jump is the median distance of their joints to those in the frame before, over their size, at most 1, and costs
    ``_JUMP`` times as much. So whoever is large and sure most of the time is kept through frames where another is
    larger for a while.
    """
    chosen = np.full(len(people), -1)
    there = [t for t, found in enumerate(people) if len(found)]
    if not there:
        return chosen
    qualities = [_quality(people[t]) for t in there]
    best = max(float(q.max()) for q in qualities) or 1.0
    score, came_from = qualities[0] / best, []
    for step, (before, now) in enumerate(pairwise(there), start=1):
        gain = score[:, None] - _JUMP * _jump(people[before], people[now])
        came_from.append(gain.argmax(0))
        score = gain.max(0) + qualities[step] / best
    person = int(score.argmax())
    for t, back in zip(reversed(there), [*reversed(came_from), None], strict=True):
        chosen[t] = person
        person = -1 if back is None else int(back[person])
    return chosen


def _size(people: Float[np.ndarray, "P K 3"]) -> Float[np.ndarray, " P"]:
    seen = seen_joints(people)[..., None]
    low = np.where(seen, people[..., :2], np.inf).min(1, initial=np.inf)
    high = np.where(seen, people[..., :2], -np.inf).max(1, initial=-np.inf)
    return np.linalg.norm(np.where(np.isfinite(low), high - np.where(np.isfinite(low), low, 0), 0), axis=-1)


def _quality(people: Float[np.ndarray, "P K 3"]) -> Float[np.ndarray, " P"]:
    return _size(people) * np.where(seen_joints(people), people[..., 2], 0).mean(-1)


def _jump(before: Float[np.ndarray, "P K 3"], now: Float[np.ndarray, "Q K 3"]) -> Float[np.ndarray, "P Q"]:
    """Median distance of the joints that both have, in sizes of the person, at most 1; 1 where none is shared."""
    both = seen_joints(before)[:, None] & seen_joints(now)[None]
    distance = np.linalg.norm(before[:, None, :, :2] - now[None, :, :, :2], axis=-1)
    ordered = np.sort(np.where(both, distance, np.inf), axis=-1)
    middle = np.maximum(both.sum(-1) - 1, 0) // 2
    median = np.take_along_axis(ordered, middle[..., None], -1)[..., 0]
    size = np.maximum(_size(before)[:, None], _size(now)[None]).clip(1e-9)
    return np.minimum(median / size, 1.0)
