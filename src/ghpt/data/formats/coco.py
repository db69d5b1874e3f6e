"""COCO results: a list of people with the images that they are in; and COCO's annotation files."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float

from ghpt.data.formats.json_views import json_files, view_name
from ghpt.data.formats.skeletons import SKELETONS
from ghpt.data.formats.validate import check_view_count, read_json
from ghpt.data.people.detections import (
    Detections,
    check_people,
    joint_values,
    merge_views,
    sort_people,
)
from ghpt.errors import GhptDataError

_MOST_DIGITS = 15
"""Of a frame number."""
_HINT = 'It must be a list of {"image_id": 12, "keypoints": [x, y, score, ...], "score": 0.9}.'


@dataclass
class _View:
    """What the images of one view hold, in any order."""

    frames: list[int] = field(default_factory=list)
    people: list[tuple[int, Float[np.ndarray, "K 3"]]] = field(default_factory=list)
    """Each person's frame number and joints."""


def read_coco(path: Path, skeleton: str | None) -> Detections:
    """Return everybody in COCO results: a file for each camera, or one with the images' names.

    In a folder the file's name is the view's. In one file it is the folder of the image
    (``cam1/000012.jpg``), or the image's name before its last number (``cam1_000012.jpg``). The
    frame number is the last number of the image's name, or the ``image_id`` where that is a number
    without a name. 17 joints are COCO's. Raises GhptDataError.
    """
    files = json_files(path)
    found: list[Detections] = []
    for file in files:
        views = _views(file, named=path.is_dir())
        for name in sorted(views):
            found.append(sort_people(file, name, views[name].frames, views[name].people))
    counts = {view.points.valid.shape[1] for view in found if len(view)}
    if skeleton is None and counts == {len(SKELETONS["coco_17"])}:
        skeleton = "coco_17"
    return merge_views(path, found, skeleton)


def _views(file: Path, named: bool) -> dict[str, _View]:
    """Return what each view holds; ``named``: the file is one view and has its name."""
    content = read_json(file)
    whole = content if isinstance(content, dict) else {"annotations": content}
    images = _objects(file, "images", whole.get("images", []))
    people = _objects(file, "annotations", whole.get("annotations"))
    counts = Counter(_key(person.get("image_id")) for person in people)
    check_people(file, "annotations", max(counts.values(), default=0))
    names = {_key(image.get("id")): image.get("file_name") for image in images}
    views: dict[str, _View] = defaultdict(_View)
    places: dict[int | str | None, tuple[str, int]] = {}

    def find(image_id: int | str | None) -> tuple[str, int]:
        """Return the view and the frame number of an image, and note the frame."""
        name = names.get(image_id)
        view, frame = _image(file, name if isinstance(name, str) else image_id, named)
        views[view].frames.append(frame)
        return view, frame

    for image_id in names:
        find(image_id)
    check_view_count(file, len(views))
    for index, person in enumerate(people):
        image_id = _key(person.get("image_id"))
        if image_id not in places:
            places[image_id] = find(image_id)
            check_view_count(file, len(views))
        joints = joint_values(file, f"[{index}].keypoints", person.get("keypoints"))
        if len(joints):
            view, frame = places[image_id]
            views[view].people.append((frame, joints))
    return views


def _objects(file: Path, field: str, listed: object) -> list[dict[str, Any]]:
    if not isinstance(listed, list) or not all(isinstance(item, dict) for item in listed):
        raise GhptDataError(file, field, "is not a list of objects", _HINT)
    return listed


def _key(image_id: Any) -> int | str | None:
    return image_id if type(image_id) in (int, str) else None


def _image(file: Path, image: int | str | None, named: bool) -> tuple[str, int]:
    """Return the view and the frame number of an image's name or number."""
    if isinstance(image, str) and image.isdigit() and len(image) <= _MOST_DIGITS:
        image = int(image)
    if isinstance(image, int) and 0 <= image < 10**_MOST_DIGITS:
        return view_name(file), image
    name = PurePosixPath(image.replace("\\", "/")) if isinstance(image, str) else PurePosixPath()
    digits = list(re.finditer(r"\d+", name.stem))
    if not digits or len(digits[-1][0]) > _MOST_DIGITS:
        problem = f"{image!r} has no frame number"
        if image is None:
            problem = "an image has neither number nor name"
        hint = "Name the images like cam1/000012.jpg, or number them."
        raise GhptDataError(file, "image_id", problem, hint)
    before = name.stem[: digits[-1].start()].rstrip(" _.-")
    view = name.parent.name or before or view_name(file)
    return (view_name(file) if named else view), int(digits[-1][0])
