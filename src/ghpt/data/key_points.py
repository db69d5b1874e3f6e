"""People's own 2D key points, as a detector wrote them: the format is recognised by its content."""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from ghpt.data.mediapipe import is_caliscope, read_caliscope
from ghpt.data.openpose import camera_folders, follow, read_people, seen_joints
from ghpt.data.skeletons import SKELETONS, joints_of, parts_of, recognise
from ghpt.data.validate import npy_header, open_input, read_npz
from ghpt.errors import GhptDataError
from ghpt.files import atomic_write

_MOST_VALUES = 1 << 31
_LONGEST_NAMES = 1 << 20
_FORMATS = (
    "Known: a folder with OpenPose's JSON files in a folder for each camera; caliscope's xy_*.csv; "
    "an npz file of ghpt (docs/calibration.md)."
)


@dataclass(frozen=True)
class KeyPoints:
    """T frames of V views of one person, in the pixels of the images as they were (lens distortion and all)."""

    path: str
    views: tuple[str, ...]
    """The views as the files call them."""
    joints: tuple[str, ...]
    """The K joints of the detector, in the words of ``ghpt.data.skeletons``."""
    frame: Int[np.ndarray, " T"]
    """Frame numbers, rising; one that a view lacks is there with nothing seen."""
    key_points: Float[np.ndarray, "T V K 2"]
    confidence: Float[np.ndarray, "T V K"]
    """In [0, 1]; 1 where the detector gives none."""
    seen: Bool[np.ndarray, "T V K"]
    rate_hz: float | None
    several: tuple[int, ...]
    """For each view the number of frames with more than one person, of whom one was followed."""


def read_key_points(path: str | Path, skeleton: str | None = None, rate_hz: int | float | None = None) -> KeyPoints:
    """The key points of a folder or file; ``skeleton`` and ``rate_hz`` say what the files do not, or overrule them.

    Raises GhptDataError for what is damaged, empty or not known, naming file, field and mend.
    """
    path = Path(path)
    if skeleton is not None:
        joints_of(path, skeleton)
    if path.is_dir():
        points = _openpose(path, skeleton)
    else:
        with open_input(path) as handle:
            start = handle.read(4096)
        if start.startswith(b"PK\x03\x04"):
            points = _own(path, skeleton)
        elif is_caliscope(start):
            points = _caliscope(path)
        else:
            raise GhptDataError(path, "", "is not a key-point format that is known", _FORMATS)
    parts_of(path, points.joints)
    for view, name in enumerate(points.views):
        if not points.seen[:, view].any():
            raise GhptDataError(path, f"view {name}", "has no key point", "Detect this view again, or leave it out.")
    if rate_hz is None:
        return points
    return KeyPoints(**{**vars(points), "rate_hz": float(rate_hz)})


def write_key_points(path: str | Path, points: KeyPoints) -> None:
    """Write the npz file that ``read_key_points`` reads."""
    arrays = {
        "views": np.array(points.views, dtype=np.str_), "joints": np.array(points.joints, dtype=np.str_),
        "frame": points.frame, "key_points": points.key_points, "confidence": points.confidence, "seen": points.seen,
    }  # fmt: skip
    if points.rate_hz is not None:
        arrays["rate_hz"] = np.array(points.rate_hz)
    with atomic_write(path) as handle:
        np.savez_compressed(handle, **arrays)


def _openpose(root: Path, skeleton: str | None) -> KeyPoints:
    folders = camera_folders(root)
    read = [read_people(folder) for folder in folders]
    frame = np.unique(np.concatenate([numbers for numbers, _ in read]))
    counts = {people[0].shape[1] for _, people in read if people[0].shape[1]}
    if len(counts) != 1:
        problem = f"the views have people of {' and '.join(map(str, sorted(counts)))} joints" if counts else "is empty"
        raise GhptDataError(root, "people", problem, "Detect all views with one model.")
    count = counts.pop()
    _check_size(root, len(frame) * len(folders) * count)
    common = set.intersection(*(set(numbers.tolist()) for numbers, _ in read))
    if len(folders) > 1 and not common:
        ranges = ", ".join(f"{folder.name} {numbers[0]} to {numbers[-1]}"
                           for folder, (numbers, _) in zip(folders, read, strict=True))  # fmt: skip
        mend = "Number the frames of synchronised cameras alike."
        raise GhptDataError(root, "frame numbers", f"no frame is in all views ({ranges})", mend)
    values = np.zeros((len(frame), len(folders), count, 3))
    several = []
    for view, (numbers, people) in enumerate(read):
        chosen = follow(people)
        there = np.flatnonzero(chosen >= 0)
        rows = np.searchsorted(frame, numbers[there])
        if len(there):
            values[rows, view] = np.stack([people[t][chosen[t]] for t in there])
        several.append(sum(len(found) > 1 for found in people))
    seen = seen_joints(values)
    if skeleton is None:
        skeleton = recognise(root, values[..., :2].reshape(-1, count, 2), seen.reshape(-1, count))
    joints = _joints_for(root, skeleton, count)
    views = tuple(folder.name for folder in folders)
    return KeyPoints(str(root), views, joints, frame, values[..., :2], values[..., 2].clip(0, 1), seen, None,
                     tuple(several))  # fmt: skip


def _caliscope(path: Path) -> KeyPoints:
    views, frame, points, seen = read_caliscope(path)
    joints = SKELETONS["mediapipe_33"]
    return KeyPoints(str(path), views, joints, frame, points, seen.astype(np.float64), seen, None, (0,) * len(views))


def _own(path: Path, skeleton: str | None) -> KeyPoints:
    there = _members(path)
    for field in ("key_points", "views"):
        if field not in there:
            raise GhptDataError(path, field, "is missing", "See docs/calibration.md for what the file holds.")
    values = read_npz(path, {"key_points": ((None, None, None, 2), "f")})["key_points"].astype(np.float64)
    frames, count_views, count, _ = values.shape
    shape = (frames, count_views, count)
    forms = {
        "confidence": (shape, "f"), "seen": (shape, "b"), "frame": ((frames,), "iu"), "rate_hz": ((), "fiu"),
    }  # fmt: skip
    more = read_npz(path, {field: form for field, form in forms.items() if field in there})
    views = _texts(path, "views")
    if skeleton is None and "skeleton" in there:
        skeleton = _texts(path, "skeleton")[0]
    joints = _texts(path, "joints") if skeleton is None and "joints" in there else ()
    finite = np.isfinite(values).all(-1)
    seen = finite & more.get("seen", finite)
    values = np.where(seen[..., None], values, 0)
    joints = joints or _joints_for(
        path, skeleton or recognise(path, values.reshape(-1, count, 2), seen.reshape(-1, count)), count
    )
    for field, names, expected in (("views", views, count_views), ("joints", joints, count)):
        if len(names) != expected or len(set(names)) != len(names):
            problem = f"names {len(names)} for {expected} of key_points, or one twice"
            raise GhptDataError(path, field, problem, "Give each a name of its own.")
    confidence = np.nan_to_num(more.get("confidence", np.ones(shape)).astype(np.float64)).clip(0, 1)
    frame = more.get("frame", np.arange(frames)).astype(np.int64)
    if not frames or (np.diff(frame) <= 0).any():
        raise GhptDataError(path, "frame", "is empty, or does not rise", "Number the frames in order.")
    rate = float(more["rate_hz"]) if "rate_hz" in more else None
    return KeyPoints(str(path), views, joints, frame, values, np.where(seen, confidence, 0), seen, rate,
                     (0,) * count_views)  # fmt: skip


_DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError, RuntimeError)
"""What zipfile raises for a damaged archive, or one of a kind that it does not know."""


def _members(path: Path) -> set[str]:
    try:
        with zipfile.ZipFile(path) as archive:
            return {name.removesuffix(".npy") for name in archive.namelist()}
    except _DAMAGED as error:
        raise GhptDataError(path, "", f"is not a whole npz file ({error})", "Write it again.") from error


def _texts(path: Path, field: str) -> tuple[str, ...]:
    try:
        with zipfile.ZipFile(path) as archive, archive.open(f"{field}.npy") as member:
            size = archive.getinfo(f"{field}.npy").file_size
            shape, _, dtype = npy_header(path, field, member, size)
            if dtype.kind != "U" or len(shape) > 1 or size > _LONGEST_NAMES:
                mend = "Write it with numpy.array([...], dtype=str)."
                raise GhptDataError(path, field, "is not a list of texts", mend)
            return tuple(map(str, np.frombuffer(member.read(), dtype).reshape(-1)))
    except (*_DAMAGED, UnicodeError) as error:
        raise GhptDataError(path, field, f"is damaged ({error})", "Write it again.") from error


def _joints_for(where: Path, skeleton: str, count: int) -> tuple[str, ...]:
    joints = joints_of(where, skeleton)
    if len(joints) != count:
        problem = f"{skeleton} has {len(joints)} joints and the key points have {count}"
        raise GhptDataError(where, "skeleton", problem, "Name the skeleton of these key points.")
    return joints


def _check_size(where: Path, values: int) -> None:
    if values > _MOST_VALUES:
        raise GhptDataError(where, "", f"holds {values} joints", "Split the recording.")
