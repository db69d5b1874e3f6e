"""Prepared recordings on disk: one raw little-endian file per field, memory-mapped, and a manifest.

Every source, synthetic or real, is prepared into this format once; a later start opens it without
reading it, so the number of frames costs no memory and no time.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ghpt.errors import GhptDataError
from ghpt.files import atomic_folder, sweep_temporaries
from ghpt.geometry.cameras import Cameras
from ghpt.observations import LabelledRecording
from ghpt.skeleton import JOINTS

_log = logging.getLogger(__name__)
FORMAT = "ghpt recordings"
VERSION = 2


@dataclass(frozen=True)
class Field:
    """An array of the store."""

    name: str
    dtype: str
    per_view: bool
    frame_shape: tuple[int, ...]
    """Shape of one frame, of one view where the field is ``per_view``."""
    unit: str

    def shape(self, frames: int, views: int) -> tuple[int, ...]:
        """Return the shape of the array of so many frames."""
        lead = (frames, views) if self.per_view else (frames,)
        return (*lead, *self.frame_shape)

    def byte_count(self, frames: int, views: int) -> int:
        """Return the size of the field's file."""
        elements = int(np.prod(self.shape(frames, views)))
        return elements * np.dtype(self.dtype).itemsize

    def path(self, folder: str | Path) -> Path:
        return Path(folder) / f"{self.name}.bin"


_J = len(JOINTS)
FIELDS = (
    Field("key_points", "<f4", True, (_J, 2), "undistorted pixels"),
    Field("confidence", "<f4", True, (_J,), "0 to 1"),
    Field("valid", "|u1", True, (_J,), "0 or 1"),
    Field("truth", "<f4", False, (_J, 3), "world, mm"),
    Field("truth_valid", "|u1", False, (_J,), "0 or 1"),
    Field("frame", "<i8", False, (), "the data set's frame number"),
)
_MASKS = ("valid", "truth_valid")

_CHUNK = 4096
"""Frames that are in memory at once while a store is written."""
_READERS = 1
"""To be raised when the real sources make something else of the same files."""
_HINT = "Delete this folder; it will be prepared anew"


@dataclass(frozen=True)
class FileEntry:
    """What the manifest says of a field's file."""

    dtype: str
    shape: Sequence[int]
    unit: str
    sha256: str


@dataclass(frozen=True)
class RecordingEntry:
    """What the manifest says of a recording: the fields' frames from ``offset`` on are its own."""

    name: str
    subject: str
    action: str
    rate_hz: float
    offset: int
    length: int
    camera_names: Sequence[str]
    K: Any
    """Nested lists of [V, 3, 3], as R and t."""
    R: Any
    t: Any

    @property
    def end(self) -> int:
        return self.offset + self.length

    @property
    def cameras(self) -> Cameras:
        K = torch.tensor(self.K, dtype=torch.float64)
        R = torch.tensor(self.R, dtype=torch.float64)
        t = torch.tensor(self.t, dtype=torch.float64)
        return Cameras(K, R, t)


@dataclass(frozen=True)
class Manifest:
    """A store's manifest.json, without its digest."""

    format: str
    version: int
    joints: Sequence[str]
    frames: int
    views: int
    camera_unit: str
    files: Mapping[str, FileEntry]
    recordings: Sequence[RecordingEntry]
    provenance: Mapping[Any, Any]


def cache_root() -> Path:
    """Return where prepared recordings go by default: ``$GHPT_CACHE``, else ``~/.cache/ghpt``."""
    from_environment = os.environ.get("GHPT_CACHE")
    return Path(from_environment or Path.home() / ".cache" / "ghpt")


def prepare(
    root: str | Path | None,
    key: dict[str, Any],
    make: Callable[[], Iterable[LabelledRecording]],
    provenance: dict[str, Any],
) -> list[LabelledRecording]:
    """Open the recordings that ``key`` stands for, after making them if no one has yet.

    ``key["name"]`` is for people; all of ``key`` (plain data) decides the folder below ``root``
    (None: `cache_root`), so it must hold everything that the content depends on. Two processes may
    make the same folder at once. Raises GhptDataError if the folder is damaged, and what ``make``
    raises, leaving nothing.
    """
    root = cache_root() if root is None else Path(root)
    text = json.dumps({"version": VERSION, **key}, sort_keys=True, allow_nan=False)
    fingerprint = hashlib.sha256(text.encode()).hexdigest()[:16]
    folder = root / f"{key['name']}-{fingerprint}"
    if not folder.exists():
        sweep_temporaries(root)
        _log.info("Preparing the recordings of %s, once for all runs, in %s.", key["name"], root)
        write_store(folder, make(), provenance | {"key": key})
    return open_store(folder)


def file_stamps(files: Iterable[Path], root: Path) -> str:
    """Return a digest of source files' names, sizes and times of change.

    It is the part of a key that notices a change.
    """
    digest = hashlib.sha256(f"readers {_READERS}".encode())
    for file in sorted(files):
        status = file.stat()
        stamp = f"{file.relative_to(root)}\0{status.st_size}\0{status.st_mtime_ns}\n"
        digest.update(stamp.encode())
    return digest.hexdigest()


def write_store(
    folder: str | Path,
    recordings: Iterable[LabelledRecording],
    provenance: Mapping[Any, Any],
) -> None:
    """Write recordings, which must have the same number of views, as a store at ``folder``.

    A store that is there is kept. Memory is constant in the number of frames, and ``folder``
    appears only when all is written. Raises GhptDataError if a recording does not fit or holds a
    value that is not finite, and if there are no frames.
    """
    with atomic_folder(folder) as temporary:
        entries, hashes = _write_fields(temporary, recordings)
        frames = entries[-1].end if entries else 0
        if frames == 0:
            where = provenance.get("source", folder)
            split = provenance.get("split", "")
            problem = "there are no frames to prepare"
            raise GhptDataError(where, split, problem, "Check the split and the files.")
        views = len(entries[0].camera_names)
        files = {}
        for field in FIELDS:
            shape = field.shape(frames, views)
            files[field.name] = FileEntry(field.dtype, shape, field.unit, hashes[field.name])
        manifest = Manifest(
            format=FORMAT,
            version=VERSION,
            joints=JOINTS,
            frames=frames,
            views=views,
            camera_unit="mm, pixels; world to camera",
            files=files,
            recordings=entries,
            provenance=provenance,
        )
        content = asdict(manifest)
        content["digest"] = _digest(content)
        text = json.dumps(content, indent=1, allow_nan=False)
        (temporary / "manifest.json").write_text(text, encoding="utf-8")


def _write_fields(
    folder: Path,
    recordings: Iterable[LabelledRecording],
) -> tuple[list[RecordingEntry], dict[str, str]]:
    """Write the fields' files. Returns the recordings' entries and the files' SHA-256."""
    hashes = {field.name: hashlib.sha256() for field in FIELDS}
    entries: list[RecordingEntry] = []
    with ExitStack() as files:
        handles = {}
        for field in FIELDS:
            handles[field.name] = files.enter_context(open(field.path(folder), "wb"))
        for recording in recordings:
            entries.append(_check_entry(recording, entries))
            for name, array in _chunks(recording):
                hashes[name].update(array.data)
                handles[name].write(array.data)
    return entries, {name: digest.hexdigest() for name, digest in hashes.items()}


def open_store(folder: str | Path) -> list[LabelledRecording]:
    """Open the recordings of a store, their arrays read-only views of memory maps.

    Only the manifest is read. Raises GhptDataError if the folder is no store of this version, or
    its manifest or a file's size is wrong.
    """
    manifest = read_manifest(folder)
    arrays = {}
    for field in FIELDS:
        shape = field.shape(manifest.frames, manifest.views)
        array = np.asarray(np.memmap(field.path(folder), field.dtype, "r", shape=shape))
        arrays[field.name] = array.view(np.bool_) if field.name in _MASKS else array
    return [_open_recording(entry, arrays) for entry in manifest.recordings]


def read_manifest(folder: str | Path) -> Manifest:
    """Read and check the manifest of a store. Raises GhptDataError."""
    path = Path(folder) / "manifest.json"
    content = _read_json(path)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise GhptDataError(path, "format", f"is not '{FORMAT}'", _HINT)
    version = content.get("version")
    if version != VERSION:
        problem = f"is {version!r}; this ghpt reads {VERSION}"
        raise GhptDataError(path, "version", problem, _HINT)
    if content.pop("digest", None) != _digest(content):
        problem = "does not fit the rest: the manifest was changed or damaged"
        raise GhptDataError(path, "digest", problem, _HINT)
    files = content.pop("files")
    recordings = content.pop("recordings")
    manifest = Manifest(
        files={name: FileEntry(**entry) for name, entry in files.items()},
        recordings=[RecordingEntry(**entry) for entry in recordings],
        **content,
    )
    for field in FIELDS:
        _check_size(field, folder, manifest)
    return manifest


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_bytes())
    except FileNotFoundError as error:
        problem = "there is no manifest, so this is no prepared recording"
        raise GhptDataError(path, "", problem, _HINT) from error
    except (OSError, ValueError, RecursionError) as error:
        raise GhptDataError(path, "", f"cannot be read ({error})", _HINT) from error


def _check_size(field: Field, folder: str | Path, manifest: Manifest) -> None:
    path = field.path(folder)
    expected = field.byte_count(manifest.frames, manifest.views)
    if not path.is_file():
        raise GhptDataError(path, field.name, "is missing", _HINT)
    found = path.stat().st_size
    if found != expected:
        problem = f"has {found} bytes instead of {expected}"
        raise GhptDataError(path, field.name, problem, _HINT)


def verify_store(folder: str | Path) -> None:
    """Read a whole store and compare each file with its SHA-256. Raises GhptDataError."""
    manifest = read_manifest(folder)
    for field in FIELDS:
        path = field.path(folder)
        with open(path, "rb") as handle:
            found = hashlib.file_digest(handle, "sha256").hexdigest()
        if found != manifest.files[field.name].sha256:
            problem = "is not what was written (SHA-256 differs)"
            raise GhptDataError(path, field.name, problem, _HINT)


def _digest(manifest: Mapping[str, Any]) -> str:
    # keys are strings, as they will be when read
    plain = json.loads(json.dumps(manifest, allow_nan=False))
    text = json.dumps(plain, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _check_entry(
    recording: LabelledRecording,
    previous: Sequence[RecordingEntry],
) -> RecordingEntry:
    """Return the manifest's entry of a recording, checked against those already written."""
    views = len(recording.camera_names)
    if previous and views != len(previous[0].camera_names):
        first = previous[0]
        problem = f"has {views} views and {first.name} has {len(first.camera_names)}"
        hint = "Prepare them as separate data sets"
        raise GhptDataError(recording.name, "camera_names", problem, hint)
    if any(recording.name == entry.name for entry in previous):
        hint = "Give each recording its own name"
        raise GhptDataError(recording.name, "name", "is there twice", hint)
    cameras = recording.cameras
    return RecordingEntry(
        name=recording.name,
        subject=recording.subject,
        action=recording.action,
        rate_hz=float(recording.rate_hz),
        offset=previous[-1].end if previous else 0,
        length=len(recording),
        camera_names=list(recording.camera_names),
        K=_check_camera(recording.name, "K", cameras.K.numpy(), (views, 3, 3)),
        R=_check_camera(recording.name, "R", cameras.R.numpy(), (views, 3, 3)),
        t=_check_camera(recording.name, "t", cameras.t.numpy(), (views, 3)),
    )


def _check_camera(
    recording: str,
    name: str,
    value: np.ndarray,
    shape: tuple[int, ...],
) -> list[Any]:
    """Return the numbers as nested lists. Raises GhptDataError if they do not fit."""
    if value.shape != shape or not np.isfinite(value).all():
        problem = f"has shape {value.shape} for {shape[0]} views, or is not finite"
        raise GhptDataError(recording, name, problem, "Check the calibration")
    return value.astype(float).tolist()


def _chunks(recording: LabelledRecording) -> Iterator[tuple[str, np.ndarray]]:
    """Yield contiguous pieces of each field in file order."""
    frames = len(recording)
    views = len(recording.camera_names)
    for field in FIELDS:
        array = getattr(recording, field.name)
        expected = field.shape(frames, views)
        if array.shape != expected:
            problem = f"has shape {array.shape} instead of {expected}"
            raise GhptDataError(recording.name, field.name, problem, "Check it")
        for start in range(0, frames, _CHUNK):
            chunk = np.ascontiguousarray(array[start : start + _CHUNK], field.dtype)
            if not np.isfinite(chunk).all():
                problem = f"is not finite in frames {start} to {start + len(chunk) - 1}"
                hint = "Put a finite value there and mask it"
                raise GhptDataError(recording.name, field.name, problem, hint)
            yield field.name, chunk


def _open_recording(entry: RecordingEntry, arrays: Mapping[str, np.ndarray]) -> LabelledRecording:
    rows = slice(entry.offset, entry.end)
    own = {name: array[rows] for name, array in arrays.items()}
    return LabelledRecording(
        name=entry.name,
        subject=entry.subject,
        action=entry.action,
        rate_hz=entry.rate_hz,
        camera_names=tuple(entry.camera_names),
        cameras=entry.cameras,
        **own,
    )
