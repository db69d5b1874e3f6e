"""Folders and files of JSON key points: OpenPose's, COCO's, AlphaPose's, MMPose's, rtmlib's and
EasyMocap's.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePath, PurePosixPath

import numpy as np

from ghpt.data.formats.frame_files import Person, read_frame_files
from ghpt.data.formats.json_content import (
    HAND_POINTS,
    JsonContent,
    JsonFrame,
    Key,
    has_face,
    has_hands,
    looks_like_people,
    read_content,
    read_people,
)
from ghpt.data.formats.layout import (
    arrange_frames,
    arrange_recordings,
    find_files,
    frame_numbers,
    without_strays,
)
from ghpt.data.formats.skeletons import SKELETONS
from ghpt.data.formats.source import Source
from ghpt.data.formats.validate import (
    LARGE_JSON,
    SMALL_JSON,
    open_input,
    opening,
)
from ghpt.data.people.detections import (
    Detections,
    check_people,
    detections_in_view,
    merge_views,
)
from ghpt.errors import GhptDataError

_log = logging.getLogger(__name__)
_LAYOUT = (
    "Put the files of each camera into a folder of its own, cam1/cam1_000000000012.json, or one "
    "file of a whole recording for each camera, cam1.json, into one folder."
)
_WITH_HANDS = "_hands"
"""What the name of a skeleton with OpenPose's hands ends in."""
_LOOKED_AT = 20
"""Files that are looked at for hands and faces."""
_MOST_DIGITS = 15
"""Of a frame number."""


def read_json_people(source: Source) -> Detections:
    """Return everybody in JSON files, each of a frame or of a whole recording.

    The layout of the files is told as ``ghpt.data.formats.layout`` says. A person's number from 0
    on is what a tracker of the view gave them; OpenPose itself writes -1. Raises GhptDataError.
    """
    files = _json_files(source.path)
    first, content = _first(files)
    if not content.format:
        problem = "is empty"
        raise GhptDataError(source.path, "people", problem, "Detect the recording again.")
    if source.format not in (None, content.format, *_SAME.get(content.format, ())):
        problem = f"is not of {source.format}: it looks like {content.format}'s"
        raise GhptDataError(first, "", problem, f"Leave format= out, or format={content.format}.")
    if not content.is_recording and _any_person(files, has_face):
        _log.info("%s: the points of faces are not read.", source.path)
    if content.is_recording:
        found = _recordings(source, files)
    elif _any_person(files, has_hands):
        return _merge_with_hands(source, _frame_files(source, files, with_hands=True))
    else:
        found = _frame_files(source, files)
    skeleton = source.skeleton
    counts = {view.points.valid.shape[1] for view in found if len(view)}
    if skeleton is None and content.format == "coco" and counts == {len(SKELETONS["coco_17"])}:
        skeleton = "coco_17"
    return merge_views(source.path, found, skeleton)


_SAME = {"coco": ("alphapose",), "openpose": ("alphapose",), "mmpose": ("rtmlib",)}
"""Tools whose files have another's form."""


def _json_files(root: Path) -> list[Path]:
    files = find_files(root, (".json",))
    if not files:
        raise GhptDataError(root, "", "holds no JSON file", _LAYOUT)
    return without_strays(files, _may_be_people)


def _may_be_people(file: Path) -> bool:
    with open_input(file) as handle:
        return looks_like_people(opening(handle.read(4096)))


def _first(files: Sequence[Path]) -> tuple[Path, JsonContent]:
    """Return the first file that tells whose it is, with its content, or the first of all."""
    for file in files:
        content = read_content(file, LARGE_JSON)
        if content.format:
            return file, content
    return files[0], content


def _any_person(files: Sequence[Path], has: Callable[[JsonContent], bool]) -> bool:
    """Return whether OpenPose was asked for hands, or faces: then the first people have them."""
    return any(_holds(file, has) for file in files[:_LOOKED_AT])


def _holds(file: Path, has: Callable[[JsonContent], bool]) -> bool:
    try:
        return has(read_content(file, SMALL_JSON))
    except GhptDataError:  # is said in its turn, after what is wrong with the files' names
        return False


def _merge_with_hands(source: Source, found: Sequence[Detections]) -> Detections:
    """Return the detections of body and hands; of the body alone where that skeleton is not known
    with hands, or is the one that is asked for.
    """
    count = max(view.points.valid.shape[1] for view in found) - 2 * HAND_POINTS
    bodies = [
        replace(view, points=view.points.select(range(count))) if len(view) else view
        for view in found
    ]
    body = merge_views(source.path, bodies, _without_hands(source.skeleton))
    known = next((name for name, points in SKELETONS.items() if points == body.joints), "")
    name = f"{known}{_WITH_HANDS}"
    if name not in SKELETONS or source.skeleton == known:
        return body
    return merge_views(source.path, found, name)


def _without_hands(skeleton: str | None) -> str | None:
    return skeleton and skeleton.removesuffix(_WITH_HANDS)


def _frame_files(
    source: Source, files: Sequence[Path], with_hands: bool = False
) -> list[Detections]:
    """Return the views of files that hold one frame each."""
    return read_frame_files(source, files, partial(_people_of_frame, with_hands=with_hands))


def _people_of_frame(file: Path, with_hands: bool) -> list[Person]:
    content = read_content(file, SMALL_JSON)
    if content.is_recording:
        problem = "holds a recording, and the files beside it hold a frame each"
        raise GhptDataError(file, "", problem, _LAYOUT)
    return read_people(file, content.frames[0], with_hands)


@dataclass(frozen=True)
class _Recording:
    """The frames of one view in a file."""

    file: Path
    view: str
    numbers: tuple[int, ...]
    """Of each of ``frames``."""
    frames: tuple[JsonFrame, ...]
    joints: tuple[str, ...]


def _recordings(source: Source, files: Sequence[Path]) -> list[Detections]:
    """Return the views of files that hold a recording each: of one view, or in one file of all."""
    root = source.path
    if not root.is_dir():
        recordings = _views_of_file(source, read_content(root, LARGE_JSON))
    else:
        names = [file.relative_to(root) for file in files]
        placed = arrange_recordings(root, names, source.session)
        recordings = [_view_of_file(files[index], view) for view, index in placed]
    named: dict[tuple[str, ...], Path] = {}
    found = []
    for recording in recordings:
        view = _read_recording(recording)
        named.setdefault(view.joints, recording.file)
        found.append(view)
    if len(named) > 1:
        problem = f"names other joints than {next(iter(named.values())).name}"
        hint = "Detect all views with one model."
        raise GhptDataError(list(named.values())[1], "meta_info", problem, hint)
    return found


def _read_recording(recording: _Recording) -> Detections:
    file = recording.file
    people = [
        (number, person)
        for number, frame in zip(recording.numbers, recording.frames, strict=True)
        for person in read_people(file, frame)
    ]
    view = _sort_people(file, recording.view, recording.numbers, people)
    count = view.points.valid.shape[1]
    if recording.joints and len(view) and count != len(recording.joints):
        problem = f"names {len(recording.joints)} joints, and people have {count}"
        field = "meta_info.keypoint_id2name"
        raise GhptDataError(file, field, problem, "Detect this view again.")
    return replace(view, joints=recording.joints)


def _sort_people(
    path: Path, view: str, frames: Sequence[int], found: Sequence[tuple[int, Person]]
) -> Detections:
    """Return one view's people, given with their frame's number in any order, by frame.

    Raises GhptDataError for people of different numbers of joints, or too many of them.
    """
    for number, person in found:
        count = len(person.joints)
        expected = len(found[0][1].joints)
        if count != expected:
            problem = (
                f"frame {number} has a person of {count} joints, frame {found[0][0]} of {expected}"
            )
            raise GhptDataError(path, "keypoints", problem, "Detect all frames with one model.")
    numbers = np.array([number for number, _ in found], np.int64)
    order = np.argsort(numbers, kind="stable")
    people = np.unique(numbers, return_counts=True)[1]
    check_people(path, "keypoints", int(people.max(initial=0)))
    values = np.zeros((0, 0, 3))
    if found:
        values = np.stack([person.joints for _, person in found])[order]
    identity = np.array([person.identity for _, person in found], np.int64)[order]
    return detections_in_view(path, view, frames, numbers[order], values, identity)


def _view_of_file(file: Path, view: str) -> _Recording:
    content = read_content(file, LARGE_JSON)
    if not content.is_recording:
        problem = "holds one frame, and the files beside it hold a recording each"
        raise GhptDataError(file, "", problem, _LAYOUT)
    images = _images(file, content.frames)
    numbers = [key for key in images if isinstance(key, int)]
    if len(numbers) < len(images):
        names = [key for key in images if isinstance(key, PurePath)]
        read = iter(frame_numbers(file, list(dict.fromkeys(names))))
        by_name = dict(zip(dict.fromkeys(names), read, strict=True))
        numbers = [key if isinstance(key, int) else by_name[key] for key in images]
    return _Recording(file, view, tuple(numbers), content.frames, content.joints)


def _views_of_file(source: Source, content: JsonContent) -> list[_Recording]:
    """Return the views of one file: of the folders or names of its images, else the file's own."""
    file = source.path
    images = _images(file, content.frames)
    if any(isinstance(key, int) for key in images):
        ((name, _),) = arrange_recordings(file.parent, [PurePath(file.name)], source.session)
        return [_view_of_file(file, name)]
    names = [*dict.fromkeys(key for key in images if isinstance(key, PurePath))]
    rows: dict[PurePath, list[int]] = defaultdict(list)
    for row, key in enumerate(images):
        if isinstance(key, PurePath):
            rows[key].append(row)
    recordings = []
    for view in arrange_frames(file, names, source.session):
        own = [(n, row) for n, index in view.files.items() for row in rows[names[index]]]
        numbers = tuple(number for number, _ in own)
        frames = tuple(content.frames[row] for _, row in own)
        recordings.append(_Recording(file, view.view, numbers, frames, content.joints))
    return recordings


def _images(file: Path, frames: Iterable[JsonFrame]) -> list[int | PurePath]:
    """Return each frame's number, or the name of its image. Raises GhptDataError for neither."""
    return [_image(file, frame.key) for frame in frames]


def _image(file: Path, key: Key) -> int | PurePath:
    if isinstance(key, str) and key.isdecimal() and len(key) <= _MOST_DIGITS:
        key = int(key)
    if isinstance(key, int) and 0 <= key < 10**_MOST_DIGITS:
        return key
    if isinstance(key, str) and key:
        return PurePosixPath(key.replace("\\", "/"))
    problem = f"{key!r} is no frame number"
    if key is None:
        problem = "an image has neither number nor name"
    hint = "Name the images like cam1/000012.jpg, or number them."
    raise GhptDataError(file, "image_id", problem, hint)
