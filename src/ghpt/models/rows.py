"""Files of rows: arrays with a row for each item of a test, and small tables. Both problems'
predictions are such.
"""

from __future__ import annotations

import json
import re
import shutil
import zipfile
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int
from torch import Tensor

from ghpt.data.formats.stored_npz import Member, add_member, members_of, text_table
from ghpt.errors import GhptDataError, GhptError
from ghpt.files import allocate, atomic_write, errors_name

FORMAT_VERSION = 1
WEIGHTS = ("entropy", "max", "effective")
"""Summaries of an item's weights: entropy (nats), the largest, and 1 / sum of squares (hypotheses
in effect).
"""
HINT = "Run the test again to make it anew"

Layout = dict[str, tuple[str, tuple[int, ...]]]
"""Name -> (dtype, shape of one row) of every array with a row for each item."""


class RowWriter:
    """Collects rows in any order, from any number of processes on one file system, at constant
    memory.

    Every process opens the same new ``folder`` and writes its rows; after all have, one calls
    ``finish``. ``items``: what a row is, for errors. ``names``: the selections and baselines, which
    arrays are called after.
    """

    def __init__(
        self, folder: str | Path, count: int, items: str, names: Sequence[str], layout: Layout
    ) -> None:
        if (
            count < 1
            or not names
            or any(not re.fullmatch("[a-z][a-z0-9_]*", name) for name in names)
        ):
            raise GhptError(
                f"predictions of {count} {items} of {list(names)}: need one and plain names"
            )
        self.folder = Path(folder)
        self.count = count
        self.items = items
        self.names = tuple(names)
        self.layout = layout | {f"weights_{summary}": ("<f4", ()) for summary in WEIGHTS}
        self.folder.mkdir(parents=True, exist_ok=True)
        for name, (dtype, shape) in (self.layout | {"written": ("|b1", ())}).items():
            size = count * np.dtype(dtype).itemsize * int(np.prod(shape))
            with open(self.folder / name, "ab") as handle:
                # Appending: a second process finds it at its full size and changes nothing.
                allocate(handle, size, self.folder / name)

    def check(self, estimates: Mapping[str, Any], weights: Mapping[str, Any]) -> None:
        """Raise GhptError unless each name has its estimate and each summary its values."""
        if set(estimates) != set(self.names) or set(weights) != set(WEIGHTS):
            raise GhptError(f"got {[*estimates, *weights]}, not {[*self.names, *WEIGHTS]}")

    def write(
        self, rows: Int[Tensor, " B"], values: Mapping[str, Tensor], weights: Mapping[str, Tensor]
    ) -> None:
        """Write items to their row numbers: a value for each array of the layout."""
        index = rows.cpu().numpy()
        for name, value in (
            values | {f"weights_{summary}": value for summary, value in weights.items()}
        ).items():
            self._put(name, index, value.detach().cpu().numpy())
        self._put("written", index, np.ones(len(index), bool))

    def finish(
        self,
        path: str | Path,
        tables: Mapping[str, np.ndarray],
        meta: Mapping[str, Any],
        verify: Callable[[Path], Any],
    ) -> None:
        """Zip all rows, ``tables`` and ``meta`` (plain data) to ``path`` and remove the folder.

        The same content gives the same bytes. Raises GhptError if a row is missing.
        """
        missing = self.count - int(self._map("written").sum())
        if missing:
            raise GhptError(
                f"{path}: {missing} of {self.count} {self.items} have no prediction; nothing was written"
            )
        meta = {"format_version": FORMAT_VERSION, "unit": "mm", "names": self.names, **meta}
        tables = {**tables, "meta": np.array(json.dumps(meta, allow_nan=False))}
        with atomic_write(path, verify=verify) as handle, zipfile.ZipFile(handle, "w") as archive:
            for name, (dtype, shape) in self.layout.items():
                with open(self.folder / name, "rb") as rows:
                    add_member(archive, name, np.dtype(dtype), (self.count, *shape), rows)
            for name, table in tables.items():
                add_member(archive, name, table.dtype, table.shape, table.tobytes())
        shutil.rmtree(self.folder, ignore_errors=True)

    def _put(self, name: str, index: Int[np.ndarray, " B"], values: np.ndarray) -> None:
        # Not through a memory map: where the disk is full that ends the process without a word
        # (SIGBUS).
        dtype, shape = (self.layout | {"written": ("|b1", ())})[name]
        rows = np.empty((len(index), *shape), dtype)
        rows[:] = values
        starts = np.flatnonzero(np.diff(index, prepend=-2) != 1)
        size = rows.nbytes // max(len(index), 1)
        with errors_name(self.folder / name), open(self.folder / name, "r+b") as handle:
            for start, stop in pairwise([*starts, len(index)]):
                handle.seek(int(index[start]) * size)
                handle.write(rows[start:stop].tobytes())

    def _map(self, name: str) -> np.memmap:
        # Mapped anew for each use: what a map has touched counts as the process's memory while it
        # is open.
        dtype, shape = (self.layout | {"written": ("|b1", ())})[name]
        return np.memmap(self.folder / name, dtype, "r+", shape=(self.count, *shape))


def read_tables(
    path: Path, texts: Sequence[str]
) -> tuple[dict[str, Member], dict[str, tuple[str, ...]], dict[str, Any], tuple[str, ...]]:
    """Members, text tables, meta and names of a file of rows; nothing in it is executed or
    unpacked.

    Raises GhptDataError if it is missing, damaged (every byte is compared with its checksum) or of
    another version.
    """
    try:
        members = members_of(path)
        tables = {name: text_table(path, members, name) for name in (*texts, "meta")}
        meta = json.loads(tables["meta"][0])
    except FileNotFoundError as error:
        raise GhptDataError(path, "", "there is no such file", "Run test.py first") from error
    except (OSError, ValueError, TypeError, EOFError, RuntimeError, zipfile.BadZipFile) as error:
        raise GhptDataError(
            path, "", f"is not a readable predictions file ({error})", HINT
        ) from error
    version = meta.get("format_version") if isinstance(meta, dict) else None
    if version != FORMAT_VERSION:
        raise GhptDataError(
            path, "meta.format_version", f"is {version!r}; this ghpt reads {FORMAT_VERSION}", HINT
        )
    names = meta.get("names")
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise GhptDataError(path, "meta.names", "is not a list of selections", HINT)
    return members, tables, meta, tuple(names)


def check_arrays(path: Path, members: Mapping[str, Member], layout: Layout, count: int) -> None:
    """Raise GhptDataError unless every array of the layout (and of the weights) is there, with
    ``count`` rows.
    """
    for name, (dtype, shape) in (
        layout | {f"weights_{summary}": ("<f4", ()) for summary in WEIGHTS}
    ).items():
        if name not in members or members[name][1:] != (np.dtype(dtype), (count, *shape)):
            raise GhptDataError(path, name, f"is not {dtype} of shape {(count, *shape)}", HINT)


def row_count(members: Mapping[str, Member], name: str) -> int:
    return members[name].shape[0] if name in members and members[name].shape else 0
