"""The views of a recording before their cameras: matched by name, out of the lens, as the 17
joints.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from ghpt.data.datasets.detections import undistort_key_points
from ghpt.data.formats.names import Name, chosen_name
from ghpt.data.formats.openpose import follow_views
from ghpt.data.formats.skeletons import joints17
from ghpt.data.people.association import associate
from ghpt.data.people.people import Detections, KeyPoints
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import Cameras, CameraSet
from ghpt.observations import Recording

_log = logging.getLogger(__name__)
_HINT = "Rename them, say which is which (match={view: camera}), or name the views to use (views=[...])."
_MOST_OUTSIDE = 0.25
_NORMALISED = 1.5
_NEARLY_ALL = 0.99
"""Nearly all coordinates of a view within this are no pixels: of the image's size, with a joint or
two beyond it.
"""
_WORDS = r"[ _.-](json|openpose|pose|keypoints|kpts|body|2d)\b"


@dataclass(frozen=True)
class Views:
    """T frames of one person in V views whose cameras may lack extrinsics: all that a calibration
    starts from.
    """

    cameras: CameraSet
    """In the order of the views; ``cameras.names`` are the views' names from here on."""
    key_points: Float[np.ndarray, "T V J 2"]
    """Undistorted pixels, float32."""
    confidence: Float[np.ndarray, "T V J"]
    valid: Bool[np.ndarray, "T V J"]
    frame: Int[np.ndarray, " T"]
    rate_hz: float | None

    def __len__(self) -> int:
        return len(self.frame)

    def part(self, views: Sequence[int]) -> Views:
        """Some of the views, in this order."""
        at = list(views)
        arrays = (self.key_points[:, at], self.confidence[:, at], self.valid[:, at])
        return Views(self.cameras.select(at), *arrays, self.frame, self.rate_hz)

    def recording(self, name: str, cameras: Cameras) -> Recording:
        """The recording as any calibration of its cameras sees it."""
        return Recording(
            name=name,
            subject=name,
            action="unknown",
            rate_hz=self.rate_hz or float("nan"),
            camera_names=self.cameras.names,
            cameras=cameras,
            key_points=self.key_points,
            confidence=self.confidence,
            valid=self.valid,
            frame=self.frame,
        )


def undistort_and_match(
    points: KeyPoints | Detections,
    cameras: CameraSet,
    match: Mapping[Name, Name] | None = None,
    views: Sequence[Name] | None = None,
    person: int = 0,
) -> Views:
    """Key points with their cameras: lens distortion undone, then the detector's joints mapped to
    the 17.

    ``views`` names those to use (by the view's or the camera's name); without it every view must
    have its camera and every camera its view. ``match`` gives the camera of a view where names do
    not tell. Of several people that one is taken who `who` says. Raises GhptDataError.
    """
    points, at, ordered = as_one_person(points, cameras, match, views, person)
    pixels = np.zeros(points.key_points[:, at].shape, np.float32)
    valid = points.valid[:, at].copy()
    check_pixels(points.path, points.key_points[:, at], valid, ordered)
    _check_sizes(points.path, points.key_points[:, at], valid, ordered)
    for view in range(len(at)):
        K = ordered.K[view].numpy()
        lens = ordered.distortion[view].numpy()
        pixels[:, view], valid[:, view] = undistort_key_points(
            points.key_points[:, at[view]], valid[:, view], K, lens
        )
    values = joints17(points.path, points.joints, pixels, points.confidence[:, at], valid)
    return Views(ordered, *values, frame=points.frame, rate_hz=points.rate_hz)


def as_one_person(
    points: KeyPoints | Detections,
    cameras: CameraSet,
    match: Mapping[str, str] | None,
    views: Sequence[str] | None,
    person: int,
) -> tuple[KeyPoints, list[int], CameraSet]:
    """One person's key points, which of their views have a camera, and these cameras in the order
    of the views.
    """
    pairs = matched(points.path, points.views, cameras, match or {}, views)
    at = [view for view, _ in pairs]
    ordered = cameras.select([camera for _, camera in pairs])
    if isinstance(points, Detections):
        points = points.pick(who(points, ordered, at, person))
    return points, at, ordered


def who(
    people: Detections, cameras: CameraSet, at: Sequence[int], person: int = 0
) -> Int[np.ndarray, "T V"]:
    """The index of one person's detection in each frame and view, -1 where there is none.

    ``cameras`` are those of the views ``at``. Where all detections have an identity, the person is
    who has the most of them (``person`` = 0), or the next. Otherwise, where nobody is ever beside
    another, everybody is one person; else, where the cameras have extrinsics, people are told apart
    across the views (`ghpt.data.people.association.associate`); and where they have none, or no two
    views agree in half of the frames, each view follows its own person
    (`ghpt.data.formats.openpose.follow`), with a warning. Raises GhptDataError if there is no such
    person.
    """
    of = np.isin(people.view, list(at))
    if len(people.identity) and (people.identity >= 0).all():
        numbers, counts = np.unique(people.identity[of], return_counts=True)
        order = numbers[np.argsort(-counts, kind="stable")]
        found = [people.of(np.flatnonzero(of & (people.identity == number))) for number in order]
        return _person(people, found, person)
    if not (people.counts()[:, at] > 1).any():
        return _person(people, [people.first()], person)
    if cameras.calibrated:
        found = _across(people, cameras, at)
        two = ((people.counts()[:, at] > 0).sum(1) >= 2).sum()
        if found and 2 * sum((chosen >= 0).any(1).sum() for chosen in found[:1]) >= two:
            return _person(people, found, person)
        doubt = "check the extrinsics of %s, and that frames have the same numbers in all views"
        words = f"%s: the views agree on nobody: {doubt}. Each view follows the person that it tracks best."
        _log.warning(words, people.path, cameras.path)
    return _person(people, [follow_views(people)], person)


def _person(people: Detections, found: Sequence[np.ndarray], person: int) -> Int[np.ndarray, "T V"]:
    if not 0 <= person < len(found):
        hint = f"Give a number below {len(found)}; 0 is who is seen most."
        raise GhptDataError(
            people.path,
            "person",
            f"there is no person {person}: {len(found)} can be told apart",
            hint,
        )
    return found[person]


def _across(
    people: Detections, cameras: CameraSet, at: Sequence[int]
) -> list[Int[np.ndarray, "T V"]]:
    """Everybody who can be told apart across the views ``at``."""
    chosen = []
    pixels = []
    valid = []
    for place, view in enumerate(at):
        of = np.flatnonzero(people.view == view)
        K = cameras.K[place].numpy()
        lens = cameras.distortion[place].numpy()
        points, there = undistort_key_points(people.key_points[of], people.valid[of], K, lens)
        chosen.append(of)
        pixels.append(points)
        valid.append(there)
    index = np.concatenate(chosen)
    values = joints17(
        people.path,
        people.joints,
        np.concatenate(pixels)[:, None],
        people.confidence[index][:, None],
        np.concatenate(valid)[:, None],
    )
    points, sure, there = (value[:, 0] for value in values)
    place = np.repeat(np.arange(len(at)), [len(of) for of in chosen])
    found = associate(
        cameras.cameras, len(people.frame), people.row[index], place, points, there, sure
    )
    people_of = []
    for one in found:
        whole = np.full((len(people.frame), len(people.views)), -1)
        whole[:, at] = np.where(one >= 0, index[one], -1)
        people_of.append(whole)
    return people_of


def matched(
    where: str,
    views: Sequence[str],
    cameras: CameraSet,
    match: Mapping[Name, Name],
    wanted: Sequence[Name] | None,
) -> list[tuple[int, int]]:
    """(view, camera) pairs, in the order of the cameras.

    A view is its camera's if ``match`` says so; if it has one of the camera's names exactly; or
    else if the names are the same but for case, separators, leading zeros and words like json
    (``cam1_json`` is ``cam_01``). Raises GhptDataError, listing both sides, where that is not one
    to one.
    """
    known = {name: None for names in _names(cameras) for name in names}
    match = {chosen_name(view, views): chosen_name(camera, known) for view, camera in match.items()}
    if wanted is not None:
        wanted = [chosen_name(name, (*views, *known)) for name in wanted]
    for view, camera in match.items():
        if view not in views or camera not in known:
            raise _unmatched(
                where, views, cameras, f"match says {view}: {camera}, of which one is not there"
            )
    found: list[tuple[int, int]] = []
    for index, view in enumerate(views):
        own = [i for i, names in enumerate(_names(cameras)) if match.get(view, view) in names]
        if not own and view not in match:
            own = [
                i for i, names in enumerate(_names(cameras)) if normal(view) in map(normal, names)
            ]
        found += [(index, camera) for camera in own]
    if wanted is not None:
        unknown = [
            name
            for name in wanted
            if not any(name in (views[v], *_names(cameras)[c]) for v, c in found)
        ]
        if unknown:
            raise _unmatched(where, views, cameras, f"there is no view {unknown[0]} with a camera")
        found = [(v, c) for v, c in found if {views[v], *_names(cameras)[c]} & set(wanted)]
    for side, names in enumerate((views, cameras.names)):
        of = [pair[side] for pair in found]
        for index in (i for i in range(len(names)) if of.count(i) != 1):
            if index in of or wanted is None:
                word, other = (("view", "camera"), ("camera", "view"))[side]
                many = f"more than one {other}" if index in of else f"no {other}"
                raise _unmatched(where, views, cameras, f"{word} {names[index]} has {many}")
    return sorted(found, key=lambda pair: pair[1])


def normal(name: str) -> str:
    """A name without case, separators, leading zeros, and words like json: ``cam1_json`` and
    ``Cam_01`` are cam1.
    """
    bare = re.sub(_WORDS, "", name.lower())
    return re.sub(
        r"(?<!\d)0+(?=\d)", "", re.sub(r"(?<=\d)[^a-z0-9]+(?=\d)", "~", bare).translate(_SEPARATORS)
    )


_SEPARATORS = {ord(c): None for c in " _.-"}


def _names(cameras: CameraSet) -> list[tuple[str, ...]]:
    return [
        (a, b) if b else (a,)
        for a, b in zip(cameras.names, cameras.other_names or ("",) * len(cameras), strict=True)
    ]


def _unmatched(where: str, views: Sequence[str], cameras: CameraSet, problem: str) -> GhptDataError:
    sides = f"views: {', '.join(views)}; cameras of {cameras.path}: {', '.join('/'.join(n) for n in _names(cameras))}"
    return GhptDataError(where, "views", f"{problem} ({sides})", _HINT)


def image_size(cameras: CameraSet) -> Float[np.ndarray, "V 2"]:
    """Width and height of the images; where the file does not say, twice the principal point."""
    if cameras.size is not None:
        return cameras.size.numpy().astype(np.float64)
    return (2 * cameras.K[:, :2, 2] + 1).numpy()


def check_pixels(
    where: str,
    pixels: Float[np.ndarray, "T V K 2"],
    valid: Bool[np.ndarray, "T V K"],
    cameras: CameraSet,
) -> None:
    """Raise GhptDataError for key points in [0, 1] or [-1, 1], as shares of the image, where pixels
    are wanted.
    """
    size = image_size(cameras)
    for view, name in enumerate(cameras.names):
        own = pixels[:, view][valid[:, view]]
        own = own[np.isfinite(own).all(-1)]
        # a detector that gives (0, 0) for what it does not see says nothing of the unit
        if not len(own) or not own.any() or size[view].min() < 20 * _NORMALISED:
            continue
        if np.quantile(np.abs(own), _NEARLY_ALL) > _NORMALISED:
            continue
        width, height = size[view]
        signed = (own < 0).any(-1).mean() > 1 - _NEARLY_ALL
        bounds = "-1 and 1" if signed else "0 and 1"
        problem = f"key points lie between {bounds} in an image of {width:.0f} x {height:.0f}: they are normalised"
        scaled = f"multiply x by {width:.0f} and y by {height:.0f}"
        if signed:
            scaled = f"add 1, then multiply x by {width / 2:g} and y by {height / 2:g}"
        hint = f"Give pixels: {scaled}; or detect again (OpenPose: --keypoint_scale 0)."
        raise GhptDataError(where, f"view {name}", problem, hint)


def _check_sizes(where: str, pixels: np.ndarray, valid: np.ndarray, cameras: CameraSet) -> None:
    """Detectors place some joints beyond the image's edge; many there are those of an image of
    another size.
    """
    if cameras.size is None:
        return
    size = image_size(cameras)
    share = _outside(pixels, valid, size)
    turned = _outside(pixels, valid, size[:, ::-1])
    for view in np.flatnonzero(share > _MOST_OUTSIDE):
        width, height = size[view]
        reach = pixels[:, view][valid[:, view]].max(0)
        image = (
            f"its image of {width:.0f} x {height:.0f}; they reach {reach[0]:.0f} x {reach[1]:.0f}"
        )
        problem = f"{share[view]:.0%} of the key points lie outside {image}"
        hint = "Give the intrinsics of the resolution that the key points were detected in."
        if turned[view] < 1 - _NEARLY_ALL:
            problem += f", as in an image of {height:.0f} x {width:.0f}: turned by 90 degrees, or x and y exchanged"
            hint = "Detect in images that are turned as the calibration's, or calibrate the turned ones."
        raise GhptDataError(where, f"view {cameras.names[view]}", problem, hint)


def _outside(
    pixels: Float[np.ndarray, "T V K 2"],
    valid: Bool[np.ndarray, "T V K"],
    size: Float[np.ndarray, "V 2"],
) -> Float[np.ndarray, " V"]:
    """The share of each view's key points beyond images of this size."""
    outside = valid & ((pixels < -0.5) | (pixels > size[:, None] - 0.5)).any(-1)
    return outside.sum((0, 2)) / valid.sum((0, 2)).clip(1)
