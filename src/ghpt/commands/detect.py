"""From videos to 2D key points, by MediaPipe's BlazePose, in the file that predict.py reads."""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from rich.progress import track

from ghpt.commands.app import Command
from ghpt.commands.catalogue import run_by_name
from ghpt.commands.display import as_started, display_path, shell_override
from ghpt.commands.outputs import Files, OutputSettings, input_paths
from ghpt.data.formats.own_npz import write_key_points
from ghpt.data.formats.skeletons import SKELETONS
from ghpt.data.points import KeyPoints
from ghpt.errors import GhptConfigError, GhptDataError, check
from ghpt.extras import check_installed

KEY_POINTS = "key_points.npz"
_ENDINGS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v")
_JOINTS = SKELETONS["mediapipe_33"]
_LEAST_SEEN = 0.01
"""Share of a video's frames with a person, below which it is an error."""
_CONVERT = "Convert it: ffmpeg -i VIDEO -c:v libx264 other.mp4"
_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class DetectSettings(OutputSettings):
    """The settings of `detect`."""

    videos: str | list[str] | None
    """A folder, or files: a video of each camera."""
    least_confidence: float
    """MediaPipe's least confidence in a person, and in the person's being followed."""
    progress_bar: bool

    def __post_init__(self) -> None:
        possible = 0 <= self.least_confidence <= 1
        hint = "It must be between 0 and 1."
        check(possible, "least_confidence", f"is {self.least_confidence}", hint)


@dataclass(frozen=True)
class View:
    """What one camera saw."""

    name: str
    key_points: Float[np.ndarray, "T 33 2"]
    """Pixels; NaN in frames without a person."""
    confidence: Float[np.ndarray, "T 33"]
    rate_hz: float
    size: tuple[int, int]
    """Width and height of the images, pixels."""

    def __len__(self) -> int:
        return len(self.key_points)

    @property
    def share(self) -> float:
        """Share of the frames that have a person."""
        return float((self.confidence > 0).any(-1).mean())


@dataclass(frozen=True)
class DetectResult:
    """The file of a detection, and what is in it."""

    path: Path
    views: tuple[View, ...]


def files(settings: DetectSettings) -> Files:
    """Return what a detection reads and writes."""
    named = settings.videos if isinstance(settings.videos, list) else [settings.videos]
    return Files(input_paths(*named), (KEY_POINTS,))


def detect(settings: DetectSettings, output: Path) -> DetectResult:
    """Find a person's 33 landmarks in the videos of all cameras.

    Writes key_points.npz into ``output``: frames that have the same number belong together, as in
    videos that begin at the same time. Raises GhptConfigError without videos or without MediaPipe,
    and GhptDataError for a video that cannot be read or shows nobody.
    """
    paths = find_videos(settings.videos)
    check_installed("mediapipe", "detect")
    check_installed("cv2", "detect")
    os.environ.setdefault("GLOG_minloglevel", "2")  # MediaPipe's warnings are of its own making
    warnings.filterwarnings("ignore", "SymbolDatabase", UserWarning)
    views = []
    for path in paths:
        view = detect_view(path, settings)
        _log.info("%s: %d frames, a person in %.0f %%", view.name, len(view), 100 * view.share)
        views.append(view)
    result = DetectResult(output / KEY_POINTS, tuple(views))
    write_views(result)
    _say_next(result)
    return result


def find_videos(videos: str | list[str] | None) -> list[Path]:
    """Return the videos of a folder, in the order of their names, or the files themselves."""
    if not videos:
        raise GhptConfigError(
            "videos", "is missing", "Name the folder of the videos: videos=videos/"
        )
    paths = [Path(one).expanduser() for one in ([videos] if isinstance(videos, str) else videos)]
    if len(paths) == 1 and paths[0].is_dir():
        found = [path for path in paths[0].iterdir() if path.suffix.lower() in _ENDINGS]
        hint = f"Existing kinds: {', '.join(_ENDINGS)}."
        check(len(found) > 0, "videos", f"there is no video in {paths[0]}", hint)
        paths = sorted(found)
    for path in paths:
        check(path.is_file(), "videos", f"there is no file {path}", "Check the name.")
    names = [path.stem for path in paths]
    distinct = len(set(names)) == len(names)
    check(
        distinct, "videos", f"two have one name ({', '.join(names)})", "Rename one: it is the view."
    )
    return paths


def detect_view(path: Path, settings: DetectSettings) -> View:
    """Return what one video shows. Raises GhptDataError if it cannot be read or shows nobody."""
    from mediapipe.python.solutions.pose import Pose

    points = []
    confidence = []
    least = settings.least_confidence
    with (
        Video(path) as video,
        Pose(min_detection_confidence=least, min_tracking_confidence=least) as model,
    ):
        hidden = not settings.progress_bar
        for image in track(video.frames(), path.stem, total=video.count, disable=hidden):
            found, sure = _landmarks(model.process(image), video.size)
            points.append(found)
            confidence.append(sure)
    if not points:
        raise GhptDataError(path, "", "has no frame that can be read", _CONVERT)
    view = View(path.stem, np.stack(points), np.stack(confidence), video.rate_hz, video.size)
    if view.share < _LEAST_SEEN:
        hint = "Lower least_confidence, or check the video."
        raise GhptDataError(path, "", "shows nobody whom MediaPipe finds", hint)
    return view


class Video:
    """A video, as a context. Raises GhptDataError for a file that is none."""

    def __init__(self, path: Path) -> None:
        import cv2

        self._opened = cv2.VideoCapture(str(path))
        self.rate_hz = float(self._opened.get(cv2.CAP_PROP_FPS))
        self.count = int(self._opened.get(cv2.CAP_PROP_FRAME_COUNT))
        """Of frames, as the file says it."""
        width = int(self._opened.get(cv2.CAP_PROP_FRAME_WIDTH))
        self.size = (width, int(self._opened.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        """Width and height, pixels."""
        if not self._opened.isOpened() or not self.rate_hz > 0:
            raise GhptDataError(path, "", "is no video that OpenCV reads", _CONVERT)

    def frames(self) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
        """Yield each frame, RGB."""
        import cv2

        there, image = self._opened.read()
        while there:
            yield cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
            there, image = self._opened.read()

    def __enter__(self) -> Video:
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.release()


def _landmarks(
    found: Any, size: tuple[int, int]
) -> tuple[Float[np.ndarray, "33 2"], Float[np.ndarray, " 33"]]:
    """Return pixels and visibility of a frame's landmarks; NaN and 0 without a person."""
    if found.pose_landmarks is None:
        return np.full((len(_JOINTS), 2), np.nan), np.zeros(len(_JOINTS))
    marks = found.pose_landmarks.landmark
    relative = np.array([(mark.x, mark.y) for mark in marks])
    return relative * size, np.array([mark.visibility for mark in marks])


def write_views(result: DetectResult) -> None:
    """Write all views into one file; a video that is shorter ends in frames without a person."""
    views = result.views
    length = max(map(len, views))
    points = np.full((length, len(views), len(_JOINTS), 2), np.nan, dtype=np.float32)
    confidence = np.zeros(points.shape[:-1], dtype=np.float32)
    for number, view in enumerate(views):
        points[: len(view), number] = view.key_points
        confidence[: len(view), number] = view.confidence
    names = [view.name for view in views]
    valid = np.asarray(np.isfinite(points).all(-1))
    found = KeyPoints(points, confidence, valid)
    write_key_points(
        result.path, names, _JOINTS, np.arange(length), found, rate_hz=views[0].rate_hz
    )


def _say_next(result: DetectResult) -> None:
    rates = {view.rate_hz for view in result.views}
    if len(rates) > 1:
        _log.warning("The videos have different rates (%s Hz).", sorted(rates))
    lengths = {len(view) for view in result.views}
    if len(lengths) > 1:
        _log.warning("The videos have different lengths: do they begin at the same time?")
    _log.info("Key points: %s", display_path(result.path))
    words = shell_override("keypoints", display_path(result.path))
    start = as_started("python predict.py")
    _log.info("Next: %s %s cameras=Calib.toml output=out/", start, words)
    sizes = {view.size for view in result.views}
    width, height = sizes.pop()
    if not sizes:
        start = as_started("python calibrate.py")
        about = f"{words} 'image_size=[{width},{height}]' output=rig/"
        _log.info("Without cameras, first: %s %s", start, about)


def summary(result: DetectResult) -> str:
    """Return the result in one line."""
    return f"{len(result.views)} views"


COMMAND = Command(name="detect", settings=DetectSettings, task=detect, summary=summary, files=files)


if __name__ == "__main__":
    run_by_name("detect")
