"""OpenPose's layout: a folder for each camera, with a JSON file for each frame."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ghpt.data.formats.validate import SMALL_JSON, check_view_count, read_json
from ghpt.data.people.detections import (
    Detections,
    check_people,
    detections_in_view,
    joint_values,
    merge_views,
)
from ghpt.errors import GhptDataError

_LAYOUT = (
    "It must hold a folder for each camera, each with a JSON file for each frame: "
    "cam1/cam1_000000000012.json."
)
_MOST_FILES = 2_000_000


def read_openpose(root: Path, skeleton: str | None) -> Detections:
    """Return everybody in OpenPose's files, or those of other detectors in its layout.

    A ``person_id`` from 0 on is the number that the view's tracker gave; OpenPose itself writes -1
    unless it tracks. Raises GhptDataError.
    """
    found = [read_view(folder) for folder in camera_folders(root)]
    return merge_views(root, found, skeleton)


def camera_folders(root: Path) -> list[Path]:
    """Return the folders that hold JSON files, by name. Raises GhptDataError if there is none."""
    inside = sorted(root.iterdir()) if root.is_dir() else []
    folders = [folder for folder in inside if folder.is_dir() and any(folder.glob("*.json"))]
    if not folders:
        hint = "Name the folder above." if root.is_dir() and any(root.glob("*.json")) else _LAYOUT
        raise GhptDataError(root, "", "holds no folder with OpenPose's JSON files", hint)
    check_view_count(root, len(folders))
    return folders


def frame_number(path: Path) -> int:
    """Return the last number in the file's name. Raises GhptDataError for a name without one."""
    digits = re.findall(r"\d+", path.stem)
    if not digits or len(digits[-1]) > 15:
        raise GhptDataError(
            path, "", "its name has no frame number", "Name the files like cam1_000012.json."
        )
    return int(digits[-1])


def read_view(folder: Path) -> Detections:
    """Return one camera's people; all have the same number of joints.

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
    numbers: list[int] = []
    identities: list[int] = []
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
    return detections_in_view(
        folder,
        folder.name,
        frames=sorted(files),
        number=np.array(numbers, np.int64),
        values=values,
        identity=np.array(identities, np.int64),
    )


def _people(path: Path) -> tuple[Float[np.ndarray, "P K 3"], list[int]]:
    """Return the people of a file and their ``person_id``, -1 without one."""
    content = read_json(path, SMALL_JSON)
    people = content.get("people") if isinstance(content, dict) else None
    if not isinstance(people, list) or not all(isinstance(person, dict) for person in people):
        raise GhptDataError(
            path, "people", "is not a list of people", "This must be a file that OpenPose wrote."
        )
    check_people(path, "people", len(people))
    found = [
        joint_values(path, f"people[{i}].pose_keypoints_2d", person.get("pose_keypoints_2d"))
        for i, person in enumerate(people)
    ]
    kept = [i for i, person in enumerate(found) if len(person)]
    if len({found[i].shape for i in kept}) > 1:
        raise GhptDataError(
            path, "people", "do not have the same number of joints", "Detect them with one model."
        )
    if not kept:
        return np.zeros((0, 0, 3)), []
    identities = [_identity(people[i].get("person_id")) for i in kept]
    return np.stack([found[i] for i in kept]), identities


def _identity(value: Any) -> int:
    if isinstance(value, list) and len(value) == 1:
        value = value[0]
    return value if type(value) is int and 0 <= value < 1 << 31 else -1
