"""Which camera each view of a recording is of, by their names."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from ghpt.data.formats.names import Name, chosen_name
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import CameraSet

_HINT = (
    "Rename them, say which is which (match={view: camera}), "
    "or name the views to use (views=[...])."
)
_WORDS = r"[ _.-](json|openpose|pose|keypoints|kpts|body|2d)\b"
_SEPARATORS = {ord(character): None for character in " _.-"}


def match_views(
    where: str,
    views: Sequence[str],
    cameras: CameraSet,
    match: Mapping[Name, Name] | None,
    wanted: Sequence[Name] | None,
) -> tuple[list[int], CameraSet]:
    """Return the views that have a camera, in the order of the cameras, and these cameras.

    A view belongs to the camera that

    1. ``match`` names for it; or else
    2. has exactly its name; or else
    3. has its name but for case, separators, leading zeros and words like json
       (``cam1_json`` is ``cam_01``).

    ``wanted`` names the views to use, by the view's or the camera's name; without it every view
    must have its camera and every camera its view. Raises GhptDataError, listing both sides, where
    views and cameras do not match one to one.
    """
    labels = camera_labels(cameras)
    known = list(dict.fromkeys(name for names in labels for name in names))
    chosen = {
        chosen_name(view, views): chosen_name(camera, known)
        for view, camera in (match or {}).items()
    }
    for view, camera in chosen.items():
        if view not in views or camera not in known:
            problem = f"match says {view}: {camera}, of which one is not there"
            raise _mismatch(where, views, cameras, problem)
    pairs = _pairs(views, labels, chosen)
    if wanted is not None:
        names = [chosen_name(name, (*views, *known)) for name in wanted]
        pairs = _select(where, views, cameras, pairs, names)
    _check_one_to_one(where, views, cameras, pairs, complete=wanted is None)
    pairs.sort(key=lambda pair: pair[1])
    at = [view for view, _ in pairs]
    return at, cameras.select([camera for _, camera in pairs])


def normalise_name(name: str) -> str:
    """Return a name without case, separators, leading zeros, and words like json.

    ``cam1_json`` and ``Cam_01`` both become cam1.
    """
    bare = re.sub(_WORDS, "", name.lower())
    apart = re.sub(r"(?<=\d)[^a-z0-9]+(?=\d)", "~", bare)
    return re.sub(r"(?<!\d)0+(?=\d)", "", apart.translate(_SEPARATORS))


def camera_labels(cameras: CameraSet) -> list[tuple[str, ...]]:
    """Return all names of each camera."""
    others = cameras.other_names or ("",) * len(cameras)
    return [
        (name, other) if other else (name,)
        for name, other in zip(cameras.names, others, strict=True)
    ]


def _pairs(
    views: Sequence[str], labels: Sequence[tuple[str, ...]], match: Mapping[str, str]
) -> list[tuple[int, int]]:
    """Return every (view, camera) that may belong together."""
    normalised = [{normalise_name(name) for name in names} for names in labels]
    pairs = []
    for index, view in enumerate(views):
        name = match.get(view, view)
        found = [camera for camera, names in enumerate(labels) if name in names]
        if not found and view not in match:
            name = normalise_name(view)
            found = [camera for camera, names in enumerate(normalised) if name in names]
        pairs += [(index, camera) for camera in found]
    return pairs


def _select(
    where: str,
    views: Sequence[str],
    cameras: CameraSet,
    pairs: Sequence[tuple[int, int]],
    wanted: Sequence[str],
) -> list[tuple[int, int]]:
    labels = camera_labels(cameras)
    names = {pair: {views[pair[0]], *labels[pair[1]]} for pair in pairs}
    for name in wanted:
        if not any(name in of_pair for of_pair in names.values()):
            problem = f"there is no view {name} with a camera"
            raise _mismatch(where, views, cameras, problem)
    return [pair for pair in pairs if names[pair] & set(wanted)]


def _check_one_to_one(
    where: str,
    views: Sequence[str],
    cameras: CameraSet,
    pairs: Sequence[tuple[int, int]],
    complete: bool,
) -> None:
    matched_views = [view for view, _ in pairs]
    matched_cameras = [camera for _, camera in pairs]
    for names, matched, word, other in (
        (views, matched_views, "view", "camera"),
        (cameras.names, matched_cameras, "camera", "view"),
    ):
        for index, name in enumerate(names):
            count = matched.count(index)
            if count > 1:
                problem = f"{word} {name} has more than one {other}"
                raise _mismatch(where, views, cameras, problem)
            if count == 0 and complete:
                raise _mismatch(where, views, cameras, f"{word} {name} has no {other}")


def _mismatch(where: str, views: Sequence[str], cameras: CameraSet, problem: str) -> GhptDataError:
    listed = ", ".join("/".join(names) for names in camera_labels(cameras))
    sides = f"views: {', '.join(views)}; cameras of {cameras.path}: {listed}"
    return GhptDataError(where, "views", f"{problem} ({sides})", _HINT)
