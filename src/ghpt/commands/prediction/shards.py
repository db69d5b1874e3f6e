"""A long reconstruction in parts of so many frames.

Each part is whole or absent, whatever kills the writer.
"""

from __future__ import annotations

import errno
import hashlib
import io
import json
import logging
import os
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import BaseFileLock

from ghpt.data.formats.stored_npz import add_member, members_of, read_rows
from ghpt.errors import GhptDataError
from ghpt.files import acquire, atomic_write, errors_name, sweep_temporaries
from ghpt.reconstruction import Reconstruction

FORMAT_VERSION = 4
MANIFEST = "manifest.jsonl"
_DTYPES = {
    "frame": "<i8",
    "points": "<f8",
    "state": "|i1",
    "error": "<f4",
    "views": "|b1",
    "covariance": "<f4",
    "score": "<f4",
    "flipped": "|b1",
}
_HINT = "Run the prediction again: what is damaged is made anew"
_SHARD = re.compile(r"\d{6,}\.npz")
_log = logging.getLogger(__name__)


class Shards:
    """The shards of ``frames`` frames in a folder: ``size`` of them in each, the rest in the last.

    The manifest's first line says what they are of (``key``); a line is appended for a shard after
    it is in place, with its SHA-256. Opening keeps the shards that the manifest vouches for and
    removes all else; of another key it keeps none. ``clean=False`` only looks: for the processes
    beside the one that opened it. Raises GhptDataError if another process has it open for writing.
    """

    def __init__(self, folder: Path, key: str, frames: int, size: int, clean: bool = True) -> None:
        self.folder = folder
        self.frames = frames
        self.size = size
        self._header = {
            "version": FORMAT_VERSION,
            "key": key,
            "frames": frames,
            "shard_frames": size,
        }
        self._lock: BaseFileLock | None = None
        if clean:
            folder.mkdir(parents=True, exist_ok=True)
            self._lock = acquire(folder / "lock", "another prediction writes here")
            self._check_folder()
        listed = self._manifest()
        self.kept = {
            shard: entry for shard, entry in listed.items() if self._is_intact(shard, entry)
        }
        if clean:
            self._clean()

    def __len__(self) -> int:
        return -(-self.frames // self.size)

    def rows(self, shard: int) -> range:
        """The rows of the recording that are this shard's."""
        return range(shard * self.size, min((shard + 1) * self.size, self.frames))

    def close(self) -> None:
        """Let others write here; the end of the process does so too."""
        if self._lock is not None:
            self._lock.release()
        self._lock = None

    def refresh(self) -> None:
        """Take in what other processes have written."""
        for shard, entry in self._manifest().items():
            if shard not in self.kept and self._is_intact(shard, entry):
                self.kept[shard] = entry

    def missing(self) -> list[int]:
        """The shards that are not there yet."""
        return [shard for shard in range(len(self)) if shard not in self.kept]

    def write(self, shard: int, part: Reconstruction) -> None:
        """Put a shard in place, then say so in the manifest."""
        content = io.BytesIO()
        with zipfile.ZipFile(content, "w") as archive:
            for name, dtype in _DTYPES.items():
                values = np.ascontiguousarray(getattr(part, name).cpu().numpy(), dtype)
                add_member(archive, name, np.dtype(dtype), values.shape, values.tobytes())
        data = content.getbuffer()
        with atomic_write(self.path(shard)) as handle:
            handle.write(data)
        self.kept[shard] = {
            "shard": shard,
            "bytes": len(data),
            "sha256": hashlib.sha256(data).hexdigest(),
        }
        with errors_name(self.folder / MANIFEST):
            self._list(_line(self.kept[shard]))

    def _list(self, line: bytes) -> None:
        manifest = os.open(self.folder / MANIFEST, os.O_WRONLY | os.O_APPEND)
        try:
            if os.write(manifest, line) != len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            os.fsync(manifest)
        finally:
            os.close(manifest)

    def read(self, shard: int) -> Reconstruction:
        """A shard that is there. Raises GhptDataError if it is no longer what was written."""
        path = self.path(shard)
        count = len(self.rows(shard))
        try:
            members = members_of(path)
            values = {name: read_rows(path, members[name], 0, count) for name in _DTYPES}
            return Reconstruction(
                **{name: torch.from_numpy(array) for name, array in values.items()}
            )
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise GhptDataError(
                path, "", f"is not the shard that was written ({error})", _HINT
            ) from error

    def chunks(self) -> Iterator[Reconstruction]:
        """All of them, in order."""
        return (self.read(shard) for shard in range(len(self)))

    def path(self, shard: int) -> Path:
        return self.folder / f"{shard:06d}.npz"

    def _check_folder(self) -> None:
        """Raise GhptDataError for shards that no manifest speaks of: another program may have made
        them.
        """
        if (self.folder / MANIFEST).exists():
            return
        for path in self.folder.iterdir():
            if _SHARD.fullmatch(path.name):
                problem = "is there, but no manifest that says what it is of"
                raise GhptDataError(path, "", problem, "Move it away, or name another output.")

    def _manifest(self) -> dict[int, dict[str, Any]]:
        """What the manifest lists; a last line that was cut off is none."""
        try:
            lines = (self.folder / MANIFEST).read_bytes().split(b"\n")
        except FileNotFoundError:
            return {}
        entries = [entry for line in lines if isinstance(entry := _parse(line), dict)]
        if not entries or entries[0] != self._header:
            _log.info("%s is of other key points, cameras or settings: starting anew.", self.folder)
            return {}
        return {
            e["shard"]: e
            for e in entries
            if type(e.get("shard")) is int and 0 <= e["shard"] < len(self)
        }

    def _is_intact(self, shard: int, entry: dict[str, Any]) -> bool:
        path = self.path(shard)
        if not path.is_file() or path.stat().st_size != entry.get("bytes"):
            return False
        with open(path, "rb") as handle:
            return hashlib.file_digest(handle, "sha256").hexdigest() == entry.get("sha256")

    def _clean(self) -> None:
        sweep_temporaries(self.folder)
        with atomic_write(self.folder / MANIFEST) as handle:
            for entry in (self._header, *(self.kept[shard] for shard in sorted(self.kept))):
                handle.write(_line(entry))
        keep = {self.path(shard) for shard in self.kept}
        for path in self.folder.iterdir():
            if _SHARD.fullmatch(path.name) and path not in keep:
                path.unlink()


def _line(entry: dict[str, Any]) -> bytes:
    return json.dumps(entry).encode() + b"\n"


def _parse(line: bytes) -> Any:
    try:
        return json.loads(line)
    except ValueError:
        return None
