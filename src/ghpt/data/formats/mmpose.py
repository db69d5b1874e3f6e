"""What MMPose 1.x writes (RTMPose among its models): a JSON file for each video."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ghpt.data.formats.json_views import json_files, view_name
from ghpt.data.formats.skeletons import canonical
from ghpt.data.formats.validate import read_json
from ghpt.data.people.detections import (
    Detections,
    check_people,
    joint_values,
    merge_views,
    sort_people,
)
from ghpt.errors import GhptDataError

_HINT = "It must be a file that MMPose wrote for a video (save_predictions, or pred_out_dir)."


def read_mmpose(path: Path, skeleton: str | None) -> Detections:
    """Return everybody in a folder with MMPose's file of each camera.

    The files' names are the views', frame numbers are ``frame_id``, and the joints' names those of
    ``meta_info``, if it is there. Raises GhptDataError.
    """
    found: list[Detections] = []
    named: dict[tuple[str, ...], Path] = {}
    for file in json_files(path):
        content = read_json(file)
        meta = content.get("meta_info", {}) if isinstance(content, dict) else {}
        frames = content.get("instance_info") if isinstance(content, dict) else content
        if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
            raise GhptDataError(file, "instance_info", "is not a list of frames", _HINT)
        joints = _joints(file, meta)
        view = _view(file, frames)
        count = view.points.valid.shape[1]
        if joints is not None and len(view) and count != len(joints):
            problem = f"names {len(joints)} joints, and people have {count}"
            raise GhptDataError(
                file, "meta_info.keypoint_id2name", problem, "Detect this view again."
            )
        named.setdefault(joints or (), file)
        found.append(replace(view, joints=joints or ()))
    if len(named) > 1:
        problem = f"names other joints than {next(iter(named.values())).name}"
        raise GhptDataError(
            list(named.values())[1], "meta_info", problem, "Detect all views with one model."
        )
    return merge_views(path, found, skeleton)


def _view(file: Path, frames: list[dict[str, Any]]) -> Detections:
    numbers = []
    found = []
    for index, frame in enumerate(frames):
        number = frame.get("frame_id")
        people = frame.get("instances")
        if type(number) is not int or not 0 <= number < 10**15:
            raise GhptDataError(
                file, f"instance_info[{index}].frame_id", "is not a frame number", _HINT
            )
        if not isinstance(people, list) or not all(isinstance(person, dict) for person in people):
            raise GhptDataError(
                file, f"instance_info[{index}].instances", "is not a list of people", _HINT
            )
        check_people(file, f"instance_info[{index}].instances", len(people))
        numbers.append(number)
        found += [
            (number, _person(file, f"instance_info[{index}].instances[{i}]", p))
            for i, p in enumerate(people)
        ]
    if len(set(numbers)) != len(numbers):
        raise GhptDataError(file, "frame_id", "is there twice", "Keep one entry for each frame.")
    return sort_people(file, view_name(file), numbers, found)


def _person(file: Path, field: str, person: dict[str, Any]) -> Float[np.ndarray, "K 3"]:
    points = person.get("keypoints")
    scores = person.get("keypoint_scores")
    if not isinstance(points, list) or not all(
        isinstance(point, list) and len(point) == 2 for point in points
    ):
        raise GhptDataError(file, f"{field}.keypoints", "is not a list of [x, y]", _HINT)
    if not isinstance(scores, list) or len(scores) != len(points):
        raise GhptDataError(
            file, f"{field}.keypoint_scores", "is not a list of a score for each joint", _HINT
        )
    return joint_values(
        file,
        field,
        [x for point, score in zip(points, scores, strict=True) for x in (*point, score)],
    )


def _joints(file: Path, meta: Any) -> tuple[str, ...] | None:
    names = meta.get("keypoint_id2name") if isinstance(meta, dict) else None
    if names is None:
        return None
    numbers = [str(index) for index in range(len(names))] if isinstance(names, dict) else []
    if (
        not numbers
        or set(names) != set(numbers)
        or not all(type(name) is str for name in names.values())
    ):
        raise GhptDataError(
            file, "meta_info.keypoint_id2name", "does not name the joints from 0 on", _HINT
        )
    return canonical([names[number] for number in numbers])
