"""Prepared recordings on disk: one raw little-endian file per field, memory-mapped, and a manifest.

Every source, synthetic or real, is prepared into this format once; a later start opens it without
reading it, so the number of frames costs no memory and no time.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ghpt.errors import GhptDataError
from ghpt.files import atomic_folder, sweep_temporaries
from ghpt.geometry.cameras import Cameras
from ghpt.observations import LabelledRecording
from ghpt.skeleton import JOINTS

FORMAT = "ghpt recordings"
VERSION = 2
FIELDS: dict[str, tuple[str, tuple[str | int, ...], str]] = {
    "key_points": ("<f4", ("V", len(JOINTS), 2), "undistorted pixels"),
    "confidence": ("<f4", ("V", len(JOINTS)), "0 to 1"),
    "valid": ("|u1", ("V", len(JOINTS)), "0 or 1"),
    "truth": ("<f4", (len(JOINTS), 3), "world, mm"),
    "truth_valid": ("|u1", (len(JOINTS),), "0 or 1"),
    "frame": ("<i8", (), "the data set's frame number"),
}
"""Field -> (dtype, shape of one frame, unit)."""

_CHUNK = 4096
"""Frames that are in memory at once while a store is written."""
_READERS = 1
"""To be raised when the real sources make something else of the same files."""
_HINT = "Delete this folder; it will be prepared anew"


def cache_root() -> Path:
    """Where prepared recordings go unless told otherwise: ``$GHPT_CACHE``, else ``~/.cache/ghpt``."""
    return Path(os.environ.get("GHPT_CACHE") or Path.home() / ".cache" / "ghpt")


def prepared(
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
    folder = root / f"{key['name']}-{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    if not folder.exists():
        sweep_temporaries(root)
        write_store(folder, make(), provenance | {"key": key})
    return open_store(folder)


def file_stamps(files: Iterable[Path], root: Path) -> str:
    """A digest of source files' names, sizes and times of change: the part of a key that notices a
    change.
    """
    digest = hashlib.sha256(f"readers {_READERS}".encode())
    for file in sorted(files):
        status = file.stat()
        digest.update(
            f"{file.relative_to(root)}\0{status.st_size}\0{status.st_mtime_ns}\n".encode()
        )
    return digest.hexdigest()


def write_store(
    folder: str | Path, recordings: Iterable[LabelledRecording], provenance: dict[str, Any]
) -> None:
    """Write recordings, which must have the same number of views, as a store at ``folder``; one
    that is there is kept.

    Memory is constant in the number of frames, and ``folder`` appears only when all is written.
    Raises GhptDataError if a recording does not fit or holds a value that is not finite, and if
    there are no frames.
    """
    with atomic_folder(folder) as temporary:
        hashes = {field: hashlib.sha256() for field in FIELDS}
        handles = {field: open(temporary / f"{field}.bin", "wb") for field in FIELDS}  # noqa: SIM115
        entries: list[dict[str, Any]] = []
        try:
            for recording in recordings:
                entries.append(_entry(recording, entries))
                for field, array in _chunks(recording):
                    hashes[field].update(array.data)
                    handles[field].write(array.data)
        finally:
            for handle in handles.values():
                handle.close()
        frames = sum(e["length"] for e in entries)
        if frames == 0:
            where = provenance.get("source", folder)
            split = provenance.get("split", "")
            raise GhptDataError(
                where, split, "there are no frames to prepare", "Check the split and the files."
            )
        views = len(entries[0]["camera_names"])
        files = {
            field: {
                "dtype": dtype,
                "shape": _shape(field, frames, views),
                "unit": unit,
                "sha256": hashes[field].hexdigest(),
            }
            for field, (dtype, _, unit) in FIELDS.items()
        }
        manifest = {
            "format": FORMAT,
            "version": VERSION,
            "joints": list(JOINTS),
            "frames": frames,
            "views": views,
            "camera_unit": "mm, pixels; world to camera",
            "files": files,
            "recordings": entries,
            "provenance": provenance,
        }
        manifest["digest"] = _digest(manifest)
        (temporary / "manifest.json").write_text(
            json.dumps(manifest, indent=1, allow_nan=False), encoding="utf-8"
        )


def open_store(folder: str | Path) -> list[LabelledRecording]:
    """The recordings of a store, their arrays read-only views of memory maps; reads the manifest
    only.

    Raises GhptDataError if the folder is no store of this version, or its manifest or a file's size
    is wrong.
    """
    manifest = read_manifest(folder)
    arrays = {
        field: np.asarray(
            np.memmap(Path(folder) / f"{field}.bin", dtype, "r", shape=tuple(f["shape"]))
        )
        for (field, (dtype, _, _)), f in zip(
            FIELDS.items(), manifest["files"].values(), strict=True
        )
    }
    arrays |= {field: arrays[field].view(np.bool_) for field in ("valid", "truth_valid")}
    return [_recording(entry, arrays) for entry in manifest["recordings"]]


def read_manifest(folder: str | Path) -> dict[str, Any]:
    """The checked manifest of a store; ``["provenance"]`` is `write_store`'s. Raises GhptDataError."""
    path = Path(folder) / "manifest.json"
    try:
        manifest = json.loads(path.read_bytes())
    except FileNotFoundError as error:
        raise GhptDataError(
            path, "", "there is no manifest, so this is no prepared recording", _HINT
        ) from error
    except (OSError, ValueError, RecursionError) as error:
        raise GhptDataError(path, "", f"cannot be read ({error})", _HINT) from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise GhptDataError(path, "format", f"is not '{FORMAT}'", _HINT)
    if manifest.get("version") != VERSION:
        problem = f"is {manifest.get('version')!r}; this ghpt reads {VERSION}"
        raise GhptDataError(path, "version", problem, _HINT)
    if manifest.pop("digest", None) != _digest(manifest):
        raise GhptDataError(
            path, "digest", "does not fit the rest: the manifest was changed or damaged", _HINT
        )
    for field, (dtype, _, _) in FIELDS.items():
        file = Path(folder) / f"{field}.bin"
        expected = (
            int(np.prod(_shape(field, manifest["frames"], manifest["views"])))
            * np.dtype(dtype).itemsize
        )
        found = file.stat().st_size if file.is_file() else None
        if found != expected:
            problem = "is missing" if found is None else f"has {found} bytes instead of {expected}"
            raise GhptDataError(file, field, problem, _HINT)
    return manifest


def verify_store(folder: str | Path) -> None:
    """Read a whole store and compare each file with its SHA-256. Raises GhptDataError."""
    for field, entry in read_manifest(folder)["files"].items():
        path = Path(folder) / f"{field}.bin"
        with open(path, "rb") as handle:
            if hashlib.file_digest(handle, "sha256").hexdigest() != entry["sha256"]:
                raise GhptDataError(path, field, "is not what was written (SHA-256 differs)", _HINT)


def _shape(field: str, frames: int, views: int) -> list[int]:
    return [frames, *(views if size == "V" else int(size) for size in FIELDS[field][1])]


def _digest(manifest: dict[str, Any]) -> str:
    plain = json.loads(
        json.dumps(manifest, allow_nan=False)
    )  # keys are strings, as they will be when read
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


def _entry(recording: LabelledRecording, before: list[dict[str, Any]]) -> dict[str, Any]:
    """The manifest's part on one recording, checked against those already written."""
    views = len(recording.camera_names)
    if before and views != len(before[0]["camera_names"]):
        problem = f"has {views} views and {before[0]['name']} has {len(before[0]['camera_names'])}"
        raise GhptDataError(
            recording.name, "camera_names", problem, "Prepare them as separate data sets"
        )
    if any(recording.name == entry["name"] for entry in before):
        raise GhptDataError(
            recording.name, "name", "is there twice", "Give each recording its own name"
        )
    cameras = {name: getattr(recording.cameras, name).numpy() for name in ("K", "R", "t")}
    for name, value in cameras.items():
        if (
            value.shape != ((views, 3) if name == "t" else (views, 3, 3))
            or not np.isfinite(value).all()
        ):
            problem = f"has shape {value.shape} for {views} views, or is not finite"
            raise GhptDataError(recording.name, name, problem, "Check the calibration")
    offset = before[-1]["offset"] + before[-1]["length"] if before else 0
    return {
        "name": recording.name,
        "subject": recording.subject,
        "action": recording.action,
        "rate_hz": float(recording.rate_hz),
        "offset": offset,
        "length": len(recording),
        "camera_names": list(recording.camera_names),
        **{name: value.astype(float).tolist() for name, value in cameras.items()},
    }


def _chunks(recording: LabelledRecording) -> Iterator[tuple[str, np.ndarray]]:
    """Contiguous pieces of each field in file order."""
    for field, (dtype, _, _) in FIELDS.items():
        array = getattr(recording, field)
        expected = tuple(_shape(field, len(recording), len(recording.camera_names)))
        if array.shape != expected:
            raise GhptDataError(
                recording.name, field, f"has shape {array.shape} instead of {expected}", "Check it"
            )
        for start in range(0, len(recording), _CHUNK):
            chunk = np.ascontiguousarray(array[start : start + _CHUNK], dtype)
            if not np.isfinite(chunk).all():
                problem = f"is not finite in frames {start} to {start + len(chunk) - 1}"
                raise GhptDataError(
                    recording.name, field, problem, "Put a finite value there and mask it"
                )
            yield field, chunk


def _recording(entry: dict[str, Any], arrays: dict[str, np.ndarray]) -> LabelledRecording:
    take = slice(entry["offset"], entry["offset"] + entry["length"])
    return LabelledRecording(
        name=entry["name"],
        subject=entry["subject"],
        action=entry["action"],
        rate_hz=entry["rate_hz"],
        camera_names=tuple(entry["camera_names"]),
        cameras=Cameras(*(torch.tensor(entry[k], dtype=torch.float64) for k in ("K", "R", "t"))),
        **{field: array[take] for field, array in arrays.items()},
    )
