"""What a JSON file of key points says, whichever detector wrote it.

A file holds one frame (a list of people) or a whole recording (a list of frames). Detectors differ
in what they call people, frames and key points, and in how deep they nest them; what a file is can
be told from its structure alone.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ghpt.data.formats.frame_files import Person
from ghpt.data.formats.skeletons import canonical
from ghpt.data.formats.validate import read_json
from ghpt.data.people.detections import check_people, joint_values
from ghpt.errors import GhptDataError

Key = int | str | None
"""A frame's number, or the name of its image, as a file has it."""
_PEOPLE = {
    "people": "openpose",
    "bodies": "openpose",
    "instances": "mmpose",
    "annots": "easymocap",
}
"""What the people of a frame are called, and by whom."""
_POINTS = ("pose_keypoints_2d", "pose_keypoints", "keypoints", "joints")
"""What a person's key points are called: OpenPose's, its own before 1.3, all others', CMU's."""
_HANDS = ("hand_left_keypoints_2d", "hand_right_keypoints_2d")
"""OpenPose's names of what is behind the body in the skeletons with hands, in their order."""
HAND_POINTS = 21
_SCORES = ("keypoint_scores", "scores")
_NUMBERS = ("frame_id", "frame_index", "frame_idx", "frame")
_IDENTITIES = ("person_id", "track_id", "personID", "idx")
"""Of OpenPose, MMPose, EasyMocap, AlphaPose."""
_KNOWN = (
    "Known are the files of OpenPose, AlphaPose, MMPose, rtmlib and EasyMocap, and COCO results "
    "(docs/calibration.md)."
)
_WORDS = (*_PEOPLE, *_POINTS, "image_id", "instance_info", "annotations", "predictions")
_MOST_NUMBER = 10**15


@dataclass(frozen=True)
class JsonFrame:
    """Some people who are in one image."""

    key: Key
    people: tuple[dict[str, Any], ...]
    field: str
    """Where the people are in the file."""
    is_person: bool = False
    """It is a list of one, and ``field`` is where that person is."""


@dataclass(frozen=True)
class JsonContent:
    """What a file holds."""

    format: str
    """Whose it is: openpose, coco, ...; "" for an empty list, which may be anybody's."""
    frames: tuple[JsonFrame, ...]
    is_recording: bool
    """False: the file is one frame, whose number its name tells."""
    joints: tuple[str, ...] = ()
    """The joints' names, where the file tells them."""


def read_content(path: Path, largest: int) -> JsonContent:
    """Return what a file of at most ``largest`` bytes holds.

    Raises GhptDataError for a file that is damaged, or of nobody's structure.
    """
    content = read_json(path, largest, nan=True)
    found = _of_dict(path, content) if isinstance(content, dict) else _of_list(path, content)
    if found is None:
        problem = "is not a key-point format that is known"
        raise GhptDataError(path, "", problem, _KNOWN)
    for frame in found.frames:
        check_people(path, frame.field, len(frame.people))
    return found


def looks_like_people(text: str) -> bool:
    """Return whether a file that begins so may be one of these."""
    return text.startswith(("{", "[")) and any(f'"{word}"' in text for word in _WORDS)


def read_people(path: Path, frame: JsonFrame, with_hands: bool = False) -> list[Person]:
    """Return the people of a frame who have key points.

    ``with_hands``: OpenPose's 21 points of the left and of the right hand are behind those of the
    body, without confidence where there are none. Raises GhptDataError.
    """
    found = []
    for index, person in enumerate(frame.people):
        place = frame.field if frame.is_person else f"{frame.field}[{index}]"
        joints = _joints(path, place, person)
        if len(joints):
            hands = [_hand(path, place, person, name) for name in _HANDS] if with_hands else []
            found.append(Person(np.concatenate([joints, *hands]), _identity(person)))
    return found


def has_hands(content: JsonContent) -> bool:
    """Return whether somebody's hands are in a file of OpenPose's."""
    people = chain.from_iterable(frame.people for frame in content.frames)
    return any(person.get(name) for person in people for name in _HANDS)


def has_face(content: JsonContent) -> bool:
    """Return whether the points of somebody's face are in a file of OpenPose's."""
    people = chain.from_iterable(frame.people for frame in content.frames)
    return any(person.get("face_keypoints_2d") for person in people)


def _hand(path: Path, place: str, person: dict[str, Any], name: str) -> Float[np.ndarray, "21 3"]:
    points = joint_values(path, f"{place}.{name}", person.get(name) or [])
    if len(points) not in (0, HAND_POINTS):
        problem = f"are {len(points)} points, not {HAND_POINTS}"
        raise GhptDataError(path, f"{place}.{name}", problem, "Detect this frame again.")
    return points if len(points) else np.zeros((HAND_POINTS, 3))


def _of_dict(path: Path, content: dict[str, Any]) -> JsonContent | None:
    for name, owner in _PEOPLE.items():
        if name in content:
            frame = JsonFrame(None, _people(path, name, content[name]), name)
            return JsonContent(owner, (frame,), False)
    if "instance_info" in content:
        joints = _joint_names(path, content.get("meta_info"))
        frames = _number_frames(path, "instance_info", content["instance_info"])
        return JsonContent("mmpose", frames, True, joints)
    if "annotations" in content or "images" in content:
        return JsonContent("coco", _coco(path, content), True)
    if "predictions" in content:
        return _predictions(path, content["predictions"])
    if "keypoints" in content:
        return _arrays(path, content)
    if content and all(isinstance(image, dict) for image in content.values()):
        return _by_image(path, content)
    return None


def _of_list(path: Path, content: Any) -> JsonContent | None:
    if not isinstance(content, list):
        return None
    if not content:
        return JsonContent("", (JsonFrame(None, (), ""),), False)
    if all(isinstance(item, list) for item in content):
        return _predictions(path, content)
    if not all(isinstance(item, dict) for item in content):
        return None
    first = content[0]
    if "image_id" in first:
        return JsonContent("coco", _coco(path, {"annotations": content}), True)
    if any(name in first for name in (*_NUMBERS, *_PEOPLE, "predictions")):
        return JsonContent("mmpose", _number_frames(path, "", content), True)
    if _depth(first.get("keypoints")) == 3:
        return JsonContent("rtmlib", _number_frames(path, "", content), True)
    if any(name in first for name in _POINTS):
        frame = JsonFrame(None, _people(path, "", content), "")
        return JsonContent("mmpose", (frame,), False)
    return None


def _people(path: Path, field: str, listed: Any) -> tuple[dict[str, Any], ...]:
    if not isinstance(listed, list) or not all(isinstance(item, dict) for item in listed):
        hint = "This must be a file that a detector wrote."
        raise GhptDataError(path, field, "is not a list of people", hint)
    return tuple(listed)


def _number_frames(path: Path, field: str, listed: Any) -> tuple[JsonFrame, ...]:
    """Return a list of frames; one without a number has its place in the list as its number."""
    if not isinstance(listed, list) or not all(isinstance(item, dict) for item in listed):
        hint = "It must be a file that MMPose wrote for a video (save_predictions, pred_out_dir)."
        raise GhptDataError(path, field, "is not a list of frames", hint)
    frames = []
    for index, item in enumerate(listed):
        place = f"{field}[{index}]"
        name = next((name for name in _NUMBERS if name in item), None)
        number = index if name is None else item[name]
        if type(number) is not int or not 0 <= number < _MOST_NUMBER:
            problem = "is not a frame number"
            raise GhptDataError(path, f"{place}.{name}", problem, "Number the frames 0, 1, 2.")
        frames.append(_frame(path, place, number, item))
    if len({frame.key for frame in frames}) != len(frames):
        raise GhptDataError(path, "frame_id", "is there twice", "Keep one entry for each frame.")
    return tuple(frames)


def _frame(path: Path, place: str, key: Key, item: dict[str, Any]) -> JsonFrame:
    """Return the people of a frame's dict, whatever they are called there."""
    name = next((name for name in (*_PEOPLE, "predictions") if name in item), "")
    people = item.get(name)
    if not name:
        return JsonFrame(key, _persons_of_arrays(path, place, item), place)
    if name == "predictions" and isinstance(people, list) and people:
        people = people[0] if isinstance(people[0], list) else people
    return JsonFrame(key, _people(path, f"{place}.{name}", people), f"{place}.{name}")


def _predictions(path: Path, listed: Any) -> JsonContent:
    """Return lists of people, one for each frame, or one list of people.

    MMPose gives a list for each image of a batch; a batch of one is a frame.
    """
    if not isinstance(listed, list) or not all(isinstance(item, list | dict) for item in listed):
        raise GhptDataError(path, "predictions", "is not a list of frames", _KNOWN)
    if all(isinstance(item, dict) for item in listed):
        frame = JsonFrame(None, tuple(listed), "predictions")
        return JsonContent("mmpose", (frame,), False)
    frames = tuple(
        JsonFrame(index, _people(path, f"predictions[{index}]", people), f"predictions[{index}]")
        for index, people in enumerate(listed)
    )
    if len(frames) == 1:
        return JsonContent("mmpose", (replace(frames[0], key=None),), False)
    return JsonContent("mmpose", frames, True)


def _arrays(path: Path, content: dict[str, Any]) -> JsonContent:
    """Return rtmlib's arrays: key points [N K 2] of a frame, or [T N K 2], with their scores."""
    points = content["keypoints"]
    if _depth(points) < 4:
        people = _persons_of_arrays(path, "", content)
        return JsonContent("rtmlib", (JsonFrame(None, people, ""),), False)
    scores = _scores_of(content)
    if not isinstance(scores, list) or len(scores) != len(points):
        raise GhptDataError(path, "scores", "are not of as many frames as keypoints", _KNOWN)
    frames = []
    for index, (own, sure) in enumerate(zip(points, scores, strict=True)):
        people = _persons_of_arrays(path, f"[{index}]", {"keypoints": own, "scores": sure})
        frames.append(JsonFrame(index, people, f"[{index}]"))
    return JsonContent("rtmlib", tuple(frames), True)


def _persons_of_arrays(
    path: Path, place: str, content: dict[str, Any]
) -> tuple[dict[str, Any], ...]:
    """Return the people whose key points [N K 2] and scores [N K] are lists of lists."""
    points = content.get("keypoints", [])
    if _depth(points) == 2:
        return (content,)
    scores = _scores_of(content)
    if not isinstance(points, list) or not isinstance(scores, list) or len(points) != len(scores):
        problem = "is not a list of people with a list of scores for each"
        raise GhptDataError(path, f"{place}.keypoints".lstrip("."), problem, _KNOWN)
    pairs = zip(points, scores, strict=True)
    return tuple({"keypoints": own, "scores": sure} for own, sure in pairs)


def _scores_of(content: dict[str, Any]) -> Any:
    for name in _SCORES:
        if name in content:
            return content[name]
    return None if content.get("keypoints") else []


def _by_image(path: Path, content: dict[str, Any]) -> JsonContent | None:
    """Return the frames of a dict with an entry for each image (AlphaPose's other forms)."""
    frames = []
    for name, image in content.items():
        if not any(word in image for word in _PEOPLE):
            return None
        frames.append(_frame(path, name, name, image))
    return JsonContent("coco", tuple(frames), True)


def _coco(path: Path, content: dict[str, Any]) -> tuple[JsonFrame, ...]:
    """Return the images of COCO results or annotations, in order; those without anybody too."""
    images = _objects(path, "images", content.get("images", []))
    people = _objects(path, "annotations", content.get("annotations"))
    counts = Counter(_key(person.get("image_id")) for person in people)
    check_people(path, "annotations", max(counts.values(), default=0))
    names = {_key(image.get("id")): image.get("file_name") for image in images}
    frames = []
    for image_id in names:
        frames.append(JsonFrame(_image_name(names, image_id), (), ""))
    for index, person in enumerate(people):
        key = _image_name(names, _key(person.get("image_id")))
        # each keeps its own place, by which an error names it
        frames.append(JsonFrame(key, (person,), f"[{index}]", is_person=True))
    return tuple(frames)


def _image_name(names: dict[Key, Any], image_id: Key) -> Key:
    name = names.get(image_id)
    return name if isinstance(name, str) else image_id


def _objects(path: Path, field: str, listed: object) -> list[dict[str, Any]]:
    if not isinstance(listed, list) or not all(isinstance(item, dict) for item in listed):
        hint = 'It must be a list of {"image_id": 12, "keypoints": [x, y, score, ...]}.'
        raise GhptDataError(path, field, "is not a list of objects", hint)
    return listed


def _key(image_id: Any) -> Key:
    return image_id if type(image_id) in (int, str) else None


def _depth(value: Any) -> int:
    """Return how deep the lists are nested, by the first of each."""
    depth = 0
    while isinstance(value, list) and value:
        depth += 1
        value = value[0]
    return depth


def _joints(path: Path, place: str, person: dict[str, Any]) -> Float[np.ndarray, "K 3"]:
    """Return x, y and confidence of a person's joints; none for ``{}``, who is not there."""
    if not person:
        return np.zeros((0, 3))
    name = next((name for name in _POINTS if name in person), None)
    if name is None:
        problem = f"has no key points: none of {', '.join(_POINTS)}"
        raise GhptDataError(path, place, problem, "Detect this frame again.")
    field = f"{place}.{name}"
    points = person[name]
    if not isinstance(points, list) or not points or not isinstance(points[0], list):
        return joint_values(path, field, points)
    if len(points[0]) == 3:
        return joint_values(path, field, _flat(path, field, points, 3))
    scores = _scores_of(person)
    if not isinstance(scores, list) or len(scores) != len(points):
        problem = "is not a list of a score for each joint"
        raise GhptDataError(path, f"{place}.{_SCORES[0]}", problem, "Detect this frame again.")
    pairs = _flat(path, field, points, 2)
    values = zip(pairs[::2], pairs[1::2], scores, strict=True)
    return joint_values(path, field, [*chain.from_iterable(values)])


def _flat(path: Path, field: str, points: list[Any], each: int) -> list[Any]:
    if not all(isinstance(point, list) and len(point) == each for point in points):
        words = "[x, y]" if each == 2 else "[x, y, confidence]"
        raise GhptDataError(path, field, f"is not a list of {words}", "Detect this frame again.")
    return [*chain.from_iterable(points)]


def _identity(person: dict[str, Any]) -> int:
    """Return what a tracker calls a person, -1 where none does; AlphaPose may write 1.0 or [1]."""
    value = next((person[name] for name in _IDENTITIES if name in person), None)
    while isinstance(value, list) and len(value) == 1:
        value = value[0]
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return value if type(value) is int and 0 <= value < 1 << 31 else -1


def _joint_names(path: Path, meta: Any) -> tuple[str, ...]:
    names = meta.get("keypoint_id2name") if isinstance(meta, dict) else None
    if names is None:
        return ()
    numbers = [str(index) for index in range(len(names))] if isinstance(names, dict) else []
    if (
        not numbers
        or set(names) != set(numbers)
        or not all(type(name) is str for name in names.values())
    ):
        problem = "does not name the joints from 0 on"
        hint = "It must be a file that MMPose wrote."
        raise GhptDataError(path, "meta_info.keypoint_id2name", problem, hint)
    return canonical([names[number] for number in numbers])
