"""OpenPose's layout: a folder for each camera, with a JSON file for each frame."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from ghpt.data.formats.validate import SMALL_JSON, check_view_count, read_json
from ghpt.data.people.people import Detections, ViewDetections, check_people, gather, triples
from ghpt.errors import GhptDataError

_LAYOUT = "It must hold a folder for each camera, each with a JSON file for each frame: cam1/cam1_000000000012.json."
_MOST_FILES = 2_000_000
_JUMP = 2.0
"""How much of a person's quality (at most 1) a jump by their own size costs."""

Frames = list[Float[np.ndarray, "_ K 3"]]
"""For each frame the people in it: x, y, confidence of their joints; pixels."""


def read_openpose(root: Path, skeleton: str | None) -> Detections:
    """Everybody in OpenPose's files, or those of other detectors in its layout. Raises
    GhptDataError.

    A ``person_id`` that all people of all views have, from 0 on, is taken as the person's number in
    all views; OpenPose itself writes -1.
    """
    found = [read_view(folder) for folder in camera_folders(root)]
    if not all((view.identity >= 0).all() for view in found):
        found = [replace(view, identity=np.full_like(view.identity, -1)) for view in found]
    return gather(root, found, None, skeleton)


def camera_folders(root: Path) -> list[Path]:
    """The folders that hold JSON files, by name. Raises GhptDataError if there is none."""
    folders = (
        [f for f in sorted(root.iterdir()) if f.is_dir() and any(f.glob("*.json"))]
        if root.is_dir()
        else []
    )
    if not folders:
        hint = "Name the folder above." if root.is_dir() and any(root.glob("*.json")) else _LAYOUT
        raise GhptDataError(root, "", "holds no folder with OpenPose's JSON files", hint)
    check_view_count(root, len(folders))
    return folders


def frame_number(path: Path) -> int:
    """The last number in the file's name. Raises GhptDataError for a name without one."""
    digits = re.findall(r"\d+", path.stem)
    if not digits or len(digits[-1]) > 15:
        raise GhptDataError(
            path, "", "its name has no frame number", "Name the files like cam1_000012.json."
        )
    return int(digits[-1])


def read_view(folder: Path) -> ViewDetections:
    """One camera's people; all have the same number of joints.

    The frame number is the last number in the file's name, so a file that is missing shifts
    nothing. Raises GhptDataError for a name without a number, a number that is there twice, and a
    damaged file.
    """
    files: dict[int, Path] = {}
    for path in sorted(folder.glob("*.json")):
        number = frame_number(path)
        if number in files:
            problem = f"has the frame number {number}, as {files[number].name} has"
            raise GhptDataError(path, "", problem, "Keep one file for each frame.")
        files[number] = path
    if len(files) > _MOST_FILES:
        raise GhptDataError(
            folder, "", f"holds {len(files)} files", f"At most {_MOST_FILES} are read."
        )
    found: list[Float[np.ndarray, "P K 3"]] = []
    numbers = []
    identities = []
    joints = 0
    for number in sorted(files):
        people, identity = _people(files[number])
        if len(people):
            if joints not in (0, people.shape[1]):
                problem = f"has people of {people.shape[1]} joints, the files before of {joints}"
                raise GhptDataError(
                    files[number], "people", problem, "Detect all frames with one model."
                )
            joints = people.shape[1]
            found.append(people)
            numbers += [number] * len(people)
            identities += identity
    values = np.concatenate(found) if found else np.zeros((0, 0, 3))
    frames = np.array(sorted(files), np.int64)
    return ViewDetections(
        folder.name, frames, np.array(numbers, np.int64), values, np.array(identities, np.int64)
    )


def _people(path: Path) -> tuple[Float[np.ndarray, "P K 3"], list[int]]:
    """The people of a file and their ``person_id``, -1 without one."""
    content = read_json(path, SMALL_JSON)
    people = content.get("people") if isinstance(content, dict) else None
    if not isinstance(people, list) or not all(isinstance(person, dict) for person in people):
        raise GhptDataError(
            path, "people", "is not a list of people", "This must be a file that OpenPose wrote."
        )
    check_people(path, "people", len(people))
    found = [
        triples(path, f"people[{i}].pose_keypoints_2d", person.get("pose_keypoints_2d"))
        for i, person in enumerate(people)
    ]
    kept = [i for i, person in enumerate(found) if len(person)]
    if len({found[i].shape for i in kept}) > 1:
        raise GhptDataError(
            path, "people", "do not have the same number of joints", "Detect them with one model."
        )
    if not kept:
        return np.zeros((0, 0, 3)), []
    return np.stack([found[i] for i in kept]), [_identity(people[i].get("person_id")) for i in kept]


def _identity(value: Any) -> int:
    if isinstance(value, list) and len(value) == 1:
        value = value[0]
    return value if type(value) is int and 0 <= value < 1 << 31 else -1


def seen_joints(people: Float[np.ndarray, "*B K 3"]) -> Bool[np.ndarray, "*B K"]:
    """Which joints were found: OpenPose writes 0, 0, 0 for the others; a confidence of 0 or less
    counts as that.
    """
    return people[..., 2] > 0


def follow_views(people: Detections) -> Int[np.ndarray, "T V"]:
    """The index of the one person who is followed through each view by itself (`follow`), -1 where
    there is nobody.
    """
    chosen = people.first()
    several = people.counts() > 1
    for view in np.flatnonzero(several.any(0)):
        of = np.flatnonzero(people.view == view)
        rows, starts = np.unique(people.row[of], return_index=True)
        values = np.concatenate(
            [people.key_points[of], np.where(people.valid, people.confidence, 0)[of, :, None]], -1
        )
        chosen[rows, view] = of[starts + follow(np.split(values, starts[1:]))]
    return chosen


def follow(people: Frames) -> Int[np.ndarray, " T"]:
    """For each frame the index of the one person that is followed through it, -1 where there is
    nobody.

    Of all ways to choose one person in each frame, the one with the greatest sum of qualities less
    jumps (Viterbi). The quality of a person is their size times their mean confidence over that of
    the best in this view; a jump is the median distance of their joints to those in the frame
    before, over their size, at most 1, and costs ``_JUMP`` times as much. So whoever is large and
    sure most of the time is kept through frames where another is larger for a while.
    """
    chosen = np.full(len(people), -1)
    there = [t for t, found in enumerate(people) if len(found)]
    if not there:
        return chosen
    qualities = [_quality(people[t]) for t in there]
    best = max(float(q.max()) for q in qualities) or 1.0
    score = qualities[0] / best
    came_from = []
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
    valid = seen_joints(people)[..., None]
    low = np.where(valid, people[..., :2], np.inf).min(1, initial=np.inf)
    high = np.where(valid, people[..., :2], -np.inf).max(1, initial=-np.inf)
    return np.linalg.norm(
        np.where(np.isfinite(low), high - np.where(np.isfinite(low), low, 0), 0), axis=-1
    )


def _quality(people: Float[np.ndarray, "P K 3"]) -> Float[np.ndarray, " P"]:
    return _size(people) * np.where(seen_joints(people), people[..., 2], 0).mean(-1)


def _jump(
    before: Float[np.ndarray, "P K 3"], now: Float[np.ndarray, "Q K 3"]
) -> Float[np.ndarray, "P Q"]:
    """Median distance of the joints that both have, in sizes of the person, at most 1; 1 where none
    is shared.
    """
    both = seen_joints(before)[:, None] & seen_joints(now)[None]
    distance = np.linalg.norm(before[:, None, :, :2] - now[None, :, :, :2], axis=-1)
    ordered = np.sort(np.where(both, distance, np.inf), axis=-1)
    middle = np.maximum(both.sum(-1) - 1, 0) // 2
    median = np.take_along_axis(ordered, middle[..., None], -1)[..., 0]
    size = np.maximum(_size(before)[:, None], _size(now)[None]).clip(1e-9)
    return np.minimum(median / size, 1.0)
