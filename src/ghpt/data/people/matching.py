"""Which camera each view of a recording is of, by their names."""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product

from ghpt.data.formats.names import Name, chosen_name
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import CameraSet

_log = logging.getLogger(__name__)
_HINT = (
    "Rename them, say which is which (match={view: camera}), "
    "or name the views to use (views=[...])."
)
_WORDS = r"[ _.-](json|openpose|pose|keypoints|kpts|body|2d)\b"
_SEPARATORS = {ord(character): None for character in " _.-"}
_PARTS = re.compile(r"\d+|[^\W\d_]+")
_MOST_PARTS = 4
"""Words or numbers that are taken off an end of a name."""
_SAID = 5
"""Cameras that a warning names; Panoptic has 520."""

_Key = Callable[[str], str]


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
       (``cam1_json`` is ``cam_01``); or else
    4. has its name once the words that all views share, or all cameras, are taken off
       (``hd_00_03`` is ``00_03``, and ``int_cam01_img`` is ``cam1_json``).

    A camera has a name of its own, and perhaps another (a table's key): those by which more views
    find a camera are taken, the own ones where both do as well.

    ``wanted`` names the views to use, by the view's or the camera's name; without it every view
    must have its camera. A camera without a view, and one without extrinsics where two others have
    them, is left out, with a warning. Raises GhptDataError, listing both sides, where a view has no
    camera, or views and cameras do not match one to one.
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
    pairs = _pairs(views, cameras, chosen)
    if wanted is not None:
        names = [chosen_name(name, (*views, *known)) for name in wanted]
        pairs = _select(where, views, cameras, pairs, names)
    _check_one_to_one(where, views, cameras, pairs, complete=wanted is None)
    if wanted is None:
        _warn_of_unmatched(views, cameras, pairs)
    _say_which(where, views, cameras, pairs, chosen)
    pairs.sort(key=lambda pair: pair[1])
    if cameras.R is not None:
        pairs = [(view, camera) for view, camera in pairs if cameras.is_posed(camera)]
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
    views: Sequence[str], cameras: CameraSet, match: Mapping[str, str]
) -> list[tuple[int, int]]:
    """Return every (view, camera) that may belong together."""
    labels = camera_labels(cameras)
    told: list[tuple[int, int]] = []
    for index, view in enumerate(views):
        if view in match:
            found = [camera for camera, names in enumerate(labels) if match[view] in names]
            told += [(index, camera) for camera in found]
    free = [index for index, view in enumerate(views) if view not in match]
    names = [views[index] for index in free]
    schemes = [_match_names(names, kind) for kind in _kinds(cameras)]
    best = max(schemes, key=_view_count, default=[])
    return told + [(free[view], camera) for view, camera in best]


def _kinds(cameras: CameraSet) -> list[Sequence[str]]:
    """Return the cameras' own names and, where the file has them, their other ones."""
    return [cameras.names, cameras.other_names] if cameras.other_names else [cameras.names]


def _match_names(views: Sequence[str], cameras: Sequence[str]) -> list[tuple[int, int]]:
    """Return every (view, camera) of equal names, by as much of the names as most views agree on.

    What all share is taken off only where more views find one camera without it.
    """
    best = _equal(views, cameras, _whole, _whole)
    for of_view, of_camera in product(_strip_shared(views), _strip_shared(cameras)):
        found = _equal(views, cameras, of_view, of_camera)
        if _view_count(found) > _view_count(best):
            best = found
    return best


def _view_count(pairs: Sequence[tuple[int, int]]) -> int:
    """Return how many views have exactly one camera."""
    return sum(count == 1 for count in Counter(view for view, _ in pairs).values())


def _equal(
    views: Sequence[str], cameras: Sequence[str], of_view: _Key, of_camera: _Key
) -> list[tuple[int, int]]:
    """Return every (view, camera) of equal names, exactly or else when normalised."""
    exact = _by_name(cameras, of_camera)
    normalised = _by_name(cameras, lambda name: normalise_name(of_camera(name)))
    pairs = []
    for index, view in enumerate(views):
        name = of_view(view)
        found = exact.get(name) or normalised.get(normalise_name(name), [])
        pairs += [(index, camera) for camera in found if cameras[camera]]
    return pairs


def _by_name(cameras: Sequence[str], of_camera: _Key) -> dict[str, list[int]]:
    """Return the cameras of each name."""
    found: dict[str, list[int]] = {}
    for index, camera in enumerate(cameras):
        found.setdefault(of_camera(camera), []).append(index)
    return found


def _whole(name: str) -> str:
    return name


def _strip_shared(names: Sequence[str]) -> Iterator[_Key]:
    """Yield functions that take off more and more of the words that all names begin or end with."""
    parts = [[part.lower() for part in _PARTS.findall(name)] for name in names]
    shortest = min(map(len, parts), default=0)
    ahead = _count_shared(parts) if len(names) > 1 else 0
    behind = _count_shared([each[::-1] for each in parts]) if len(names) > 1 else 0
    for start, end in product(range(ahead + 1), range(behind + 1)):
        if start + end < max(shortest, 1):
            yield _cutter(start, end)


def _count_shared(parts: Sequence[Sequence[str]]) -> int:
    """Return with how many equal words all lists begin, at most ``_MOST_PARTS``."""
    count = 0
    for same in zip(*parts, strict=False):
        if len(set(same)) > 1 or count == _MOST_PARTS:
            break
        count += 1
    return count


def _cutter(start: int, end: int) -> _Key:
    """Return what takes so many words off the begin and the end of a name."""

    def strip(name: str) -> str:
        found = list(_PARTS.finditer(name))
        kept = found[start : len(found) - end]
        return name[kept[0].start() : kept[-1].end()] if kept and start + end else name

    return strip


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
    cameras_of = Counter(view for view, _ in pairs)
    views_of = Counter(camera for _, camera in pairs)
    for index, name in enumerate(views):
        if cameras_of[index] > 1:
            raise _mismatch(where, views, cameras, f"view {name} has more than one camera")
        if complete and not cameras_of[index]:
            raise _mismatch(where, views, cameras, f"view {name} has no camera")
    for index, name in enumerate(cameras.names):
        if views_of[index] > 1:
            raise _mismatch(where, views, cameras, f"camera {name} has more than one view")


def _say_which(
    where: str,
    views: Sequence[str],
    cameras: CameraSet,
    pairs: Sequence[tuple[int, int]],
    match: Mapping[str, str],
) -> None:
    """Say which view is taken for which camera, where that is not plain from their names."""
    labels = camera_labels(cameras)
    said = []
    for view, camera in pairs:
        names = {normalise_name(name) for name in labels[camera]}
        if views[view] not in match and normalise_name(views[view]) not in names:
            said.append(f"{views[view]} is {cameras.names[camera]}")
    if said:
        _log.info("%s: by what their names share, %s.", where, ", ".join(said))


def _warn_of_unmatched(
    views: Sequence[str], cameras: CameraSet, pairs: Sequence[tuple[int, int]]
) -> None:
    matched = {camera for _, camera in pairs}
    unseen = [name for index, name in enumerate(cameras.names) if index not in matched]
    if unseen:
        more = f" and {len(unseen) - _SAID} more" if len(unseen) > _SAID else ""
        text = "%s: not used, as no view is of it: %s%s."
        _log.warning(text, cameras.path, ", ".join(unseen[:_SAID]), more)
    if cameras.R is None:
        return
    for view, camera in pairs:
        if not cameras.is_posed(camera):
            text = "%s: %s has no extrinsics: view %s is not used. Calibrate all of them."
            _log.warning(text, cameras.path, cameras.names[camera], views[view])


def _mismatch(where: str, views: Sequence[str], cameras: CameraSet, problem: str) -> GhptDataError:
    listed = ", ".join("/".join(names) for names in camera_labels(cameras))
    sides = f"views: {', '.join(views)}; cameras of {cameras.path}: {listed}"
    return GhptDataError(where, "views", f"{problem} ({sides})", _HINT)
