"""What a path holds where it does not hold what was wanted: for an error that helps."""

from __future__ import annotations

from collections.abc import Iterator
from difflib import get_close_matches
from itertools import islice
from pathlib import Path

from ghpt.data.formats.camera_files import read_cameras
from ghpt.data.formats.key_points import format_of
from ghpt.errors import GhptDataError

_VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".m4v", ".mpg", ".mpeg", ".webm", ".mts")
_IMAGES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff")
_KEY_POINTS = (".h5", ".hdf5", ".slp", ".csv", ".npz", ".npy", ".json", ".txt")
_WORDS = (b"keypoints", b'"people"', b'"instance', b"sync_index", b"scorer", b"NUMPY", b"\x89HDF")
"""Of which one is at the begin of a file of key points, but for archives."""
_SETTINGS = ("skeleton", "session", "rate_hz", "format", "least_confidence")
"""Of which an error says something, whatever the format is."""
_LOOKED_AT = 200
"""Files and folders of a folder that are looked at."""
_OWN = "For a first try: python detect.py videos={folder} output=pose/. Or "
_DETECT = (
    "Run a 2D detector first: OpenPose (openpose.bin --video {file} --write_json {view}_json), "
    "or MMPose (python demo/inferencer_demo.py {file} --pose2d body26 --pred-out-dir pose)."
)


def explain_key_points(
    error: GhptDataError, path: Path, cameras: Path | None, named: bool = False
) -> GhptDataError:
    """Return the error of reading key points, or one that says what ``path`` holds instead.

    ``cameras`` is where the cameras are said to be. Unless the format was ``named``, the error says
    what it was taken for.
    """
    if not path.exists():
        return _missing(path)
    media = _media(path)
    if media is not None:
        kind, file = media
        is_video = kind == "videos"
        hint = _DETECT.format(file=file.name, view=file.stem if is_video else "cam1")
        if is_video:
            hint = _OWN.format(folder=file.parent) + hint[0].lower() + hint[1:]
        return GhptDataError(path, "", f"holds {kind} ({file.name}), not key points", hint)
    form = _camera_format(path)
    if form is not None:
        problem = f"holds cameras ({form}), not key points"
        exchanged = cameras is not None and _looks_like_key_points(cameras)
        hint = "Exchange keypoints= and cameras=." if exchanged else "Name it as cameras=."
        return GhptDataError(path, "", problem, hint)
    return error if named or error.field in _SETTINGS else _with_format(error, path)


def explain_cameras(error: GhptDataError, path: Path, key_points: Path | None) -> GhptDataError:
    """Return the error of reading cameras, or one that says what ``path`` holds instead."""
    if not path.exists():
        return _missing(path)
    media = _media(path)
    if media is not None:
        kind, file = media
        hint = "Name the calibration: cameras=Calib.toml, say."
        return GhptDataError(path, "", f"holds {kind} ({file.name}), not cameras", hint)
    below = [entry for entry in _entries(path) if entry.is_dir() and _camera_format(entry)]
    if below and not _camera_format(path):
        hint = f"Name the folder below: cameras={below[0]}"
        return GhptDataError(path, "", error.problem, hint)
    if _looks_like_key_points(path):
        exchanged = key_points is not None and _camera_format(key_points) is not None
        hint = "Exchange keypoints= and cameras=." if exchanged else "Name it as keypoints=."
        return GhptDataError(path, "", "holds key points, not cameras", hint)
    return error


def _with_format(error: GhptDataError, path: Path) -> GhptDataError:
    """Return the error with the format that the key points were taken for, if for any."""
    try:
        form = format_of(path)
    except GhptDataError:
        return error
    problem = f"{error.problem} (taken for {form}; format= names another)"
    return GhptDataError(error.where, error.field, problem, error.hint)


def _missing(path: Path) -> GhptDataError:
    """Return the error for a path that is not there, with what is there."""
    above = path.parent
    while not above.exists():
        above = above.parent
    names = [entry.name for entry in _entries(above) if not entry.name.startswith(".")]
    missing = path.relative_to(above).parts[0]
    close = get_close_matches(missing, names, n=1)
    shown = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
    hint = f"Did you mean {close[0]}? " if close else ""
    hint += f"{above} holds {shown or 'nothing'}."
    return GhptDataError(path, "", "there is no such file or folder", hint)


def _entries(path: Path) -> list[Path]:
    return sorted(islice(path.iterdir(), _LOOKED_AT)) if path.is_dir() else []


def _files(path: Path) -> Iterator[Path]:
    """Yield a file itself, or the first files in a folder and in the folders in it."""
    if path.is_file():
        yield path
        return
    inside = (file for pattern in ("*", "*/*") for file in path.glob(pattern))
    yield from (file for file in islice(inside, _LOOKED_AT) if _is_visible_file(file))


def _is_visible_file(path: Path) -> bool:
    return not path.name.startswith(".") and path.is_file()


def _media(path: Path) -> tuple[str, Path] | None:
    """Return that a path holds videos or images, with one of them, where no key points are."""
    files = list(_files(path))
    if any(file.suffix.lower() in _KEY_POINTS for file in files):
        return None
    for kind, endings in (("videos", _VIDEOS), ("images", _IMAGES)):
        found = [file for file in files if file.suffix.lower() in endings]
        if found:
            return kind, min(found)
    return None


def _camera_format(path: Path) -> str | None:
    """Return the format of a path's cameras; None where it holds none."""
    try:
        return read_cameras(path).format
    except GhptDataError as error:
        # a rig whose subject is not chosen is one, too
        return "Human3.6M" if error.field == "subject" else None


def _looks_like_key_points(path: Path) -> bool:
    for file in _files(path):
        if file.suffix.lower() not in _KEY_POINTS:
            continue
        try:
            with open(file, "rb") as handle:
                start = handle.read(4096)
        except OSError:
            continue
        if start.startswith(b"PK\x03\x04") or any(word in start for word in _WORDS):
            return True
    return False
