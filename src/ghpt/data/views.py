"""The views of a recording before their cameras: matched by name, out of the lens, as the 17 joints."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from ghpt.data.camera_files import CameraFile
from ghpt.data.detections import undistorted
from ghpt.data.key_points import KeyPoints
from ghpt.data.skeletons import joints17
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import Cameras
from ghpt.recording import Recording
from ghpt.skeleton import JOINTS

_MEND = "Rename them, say which is which (match={view: camera}), or name the views to use (views=[...])."
_MOST_OUTSIDE = 0.25
_WORDS = r"[ _.-](json|openpose|pose|keypoints|kpts|body|2d)\b"


@dataclass(frozen=True)
class Views:
    """T frames of one person in V views whose cameras may lack extrinsics: all that a calibration starts from."""

    cameras: CameraFile
    """In the order of the views; ``cameras.names`` are the views' names from here on."""
    key_points: Float[np.ndarray, "T V J 2"]
    """Undistorted pixels, float32."""
    confidence: Float[np.ndarray, "T V J"]
    seen: Bool[np.ndarray, "T V J"]
    frame: Int[np.ndarray, " T"]
    rate_hz: float | None

    def __len__(self) -> int:
        return len(self.frame)

    def part(self, views: Sequence[int]) -> Views:
        """Some of the views, in this order."""
        at = list(views)
        arrays = (self.key_points[:, at], self.confidence[:, at], self.seen[:, at])
        return Views(self.cameras.select(at), *arrays, self.frame, self.rate_hz)

    def recording(self, name: str, cameras: Cameras) -> Recording:
        """The recording as any calibration of its cameras sees it; without a truth."""
        return Recording(
            name=name, subject=name, action="unknown", rate_hz=self.rate_hz or float("nan"),
            camera_names=self.cameras.names, cameras=cameras, key_points=self.key_points,
            confidence=self.confidence, seen=self.seen, truth=np.zeros((len(self), len(JOINTS), 3), np.float32),
            truth_seen=np.zeros((len(self), len(JOINTS)), bool), frame=self.frame,
        )  # fmt: skip


def look_through(
    points: KeyPoints,
    cameras: CameraFile,
    match: Mapping[str, str] | None = None,
    views: Sequence[str] | None = None,
) -> Views:
    """Key points with their cameras: lens distortion undone, then the detector's joints mapped to the 17.

    ``views`` names those to use (by the view's or the camera's name); without it every view must have its camera and
    every camera its view. ``match`` gives the camera of a view where names do not tell. Raises GhptDataError.
    """
    pairs = matched(points.path, points.views, cameras, match or {}, views)
    at, ordered = [view for view, _ in pairs], cameras.select([camera for _, camera in pairs])
    pixels, seen = np.zeros(points.key_points[:, at].shape, np.float32), points.seen[:, at].copy()
    _check_sizes(points.path, points.key_points[:, at], seen, ordered)
    for view in range(len(at)):
        K, lens = ordered.K[view].numpy(), ordered.distortion[view].numpy()
        pixels[:, view], seen[:, view] = undistorted(points.key_points[:, at[view]], seen[:, view], K, lens)
    values = joints17(points.path, points.joints, pixels, points.confidence[:, at], seen)
    return Views(ordered, *values, frame=points.frame, rate_hz=points.rate_hz)


def matched(
    where: str, views: Sequence[str], cameras: CameraFile, match: Mapping[str, str], wanted: Sequence[str] | None
) -> list[tuple[int, int]]:
    """(view, camera) pairs, in the order of the cameras.

    A view is its camera's if ``match`` says so; if it has one of the camera's names exactly; or else if the names
    are the same but for case, separators, leading zeros and words like json (``cam1_json`` is ``cam_01``). Raises
    GhptDataError, listing both sides, where that is not one to one.
    """
    known = {name for names in _names(cameras) for name in names}
    for view, camera in match.items():
        if view not in views or camera not in known:
            raise _unmatched(where, views, cameras, f"match says {view}: {camera}, of which one is not there")
    found: list[tuple[int, int]] = []
    for index, view in enumerate(views):
        own = [i for i, names in enumerate(_names(cameras)) if match.get(view, view) in names]
        if not own and view not in match:
            own = [i for i, names in enumerate(_names(cameras)) if normal(view) in map(normal, names)]
        found += [(index, camera) for camera in own]
    if wanted is not None:
        unknown = [name for name in wanted if not any(name in (views[v], *_names(cameras)[c]) for v, c in found)]
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
    """A name without case, separators, leading zeros, and words like json: ``cam1_json`` and ``Cam_01`` are cam1."""
    bare = re.sub(_WORDS, "", name.lower())
    return re.sub(r"(?<!\d)0+(?=\d)", "", re.sub(r"(?<=\d)[^a-z0-9]+(?=\d)", "~", bare).translate(_SEPARATORS))


_SEPARATORS = {ord(c): None for c in " _.-"}


def _names(cameras: CameraFile) -> list[tuple[str, ...]]:
    return [(a, b) if b else (a,) for a, b in zip(cameras.names, cameras.other_names, strict=True)]


def _unmatched(where: str, views: Sequence[str], cameras: CameraFile, problem: str) -> GhptDataError:
    sides = f"views: {', '.join(views)}; cameras of {cameras.path}: {', '.join('/'.join(n) for n in _names(cameras))}"
    return GhptDataError(where, "views", f"{problem} ({sides})", _MEND)


def _check_sizes(where: str, pixels: np.ndarray, seen: np.ndarray, cameras: CameraFile) -> None:
    """Detectors place some joints beyond the image's edge; many there are those of an image of another size."""
    if cameras.size is None:
        return
    size = cameras.size.numpy()
    outside = seen & ((pixels < -0.5) | (pixels > size[:, None] - 0.5)).any(-1)
    share = outside.sum((0, 2)) / seen.sum((0, 2)).clip(1)
    for view in np.flatnonzero(share > _MOST_OUTSIDE):
        width, height = size[view]
        reach = pixels[:, view][seen[:, view]].max(0)
        image = f"its image of {width} x {height}; they reach {reach[0]:.0f} x {reach[1]:.0f}"
        problem = f"{share[view]:.0%} of the key points lie outside {image}"
        mend = "Give the intrinsics of the resolution that the key points were detected in."
        raise GhptDataError(where, f"view {cameras.names[view]}", problem, mend)
