"""A file of arrays with a row for each sample, written by several processes at constant memory."""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int
from torch import Tensor

from ghpt.data.formats.stored_npz import add_member
from ghpt.errors import GhptError
from ghpt.files import allocate, atomic_write, errors_name

Column = tuple[str, tuple[int, ...]]
"""Data type and shape of one row of an array."""
Layout = dict[str, Column]
"""The column of each array that has a row for each sample, by name."""
_WRITTEN = "written"
"""The array that says which rows are there."""


class RowWriter:
    """Collects ``count`` rows in any order, from any number of processes on one file system.

    Every process opens the same new ``folder`` and writes its rows; after all have, one calls
    ``finish``. Memory does not grow with the number of rows.
    """

    def __init__(self, folder: str | Path, count: int, layout: Layout) -> None:
        self.folder = Path(folder)
        self.count = count
        self.layout = layout
        self._columns = layout | {_WRITTEN: ("|b1", ())}
        self.folder.mkdir(parents=True, exist_ok=True)
        for name, (dtype, shape) in self._columns.items():
            path = self.folder / name
            size = count * np.dtype(dtype).itemsize * int(np.prod(shape))
            with open(path, "ab") as handle:
                # Appending: a second process finds it at its full size and changes nothing.
                allocate(handle, size, path)

    def write(self, index: Int[Tensor, " B"], values: Mapping[str, Tensor]) -> None:
        """Write samples to their row numbers: a value for each array of the layout."""
        rows = index.cpu().numpy()
        for name in self.layout:
            self._put(name, rows, values[name].detach().cpu().numpy())
        self._put(_WRITTEN, rows, np.ones(len(rows), bool))

    def finish(
        self,
        path: str | Path,
        tables: Mapping[str, np.ndarray],
        meta: Mapping[str, Any],
        verify: Callable[[Path], object],
    ) -> None:
        """Zip all rows, ``tables`` and ``meta`` (plain data) to ``path`` and remove the folder.

        The same content gives the same bytes. Raises GhptError if a row is missing.
        """
        missing = self.count - int(self._map(_WRITTEN).sum())
        if missing:
            raise GhptError(
                f"{path}: {missing} of {self.count} samples have no prediction; nothing was written"
            )
        meta_array = np.array(json.dumps(dict(meta), allow_nan=False))
        with atomic_write(path, verify=verify) as handle, zipfile.ZipFile(handle, "w") as archive:
            for name, (dtype, shape) in self.layout.items():
                with open(self.folder / name, "rb") as rows:
                    add_member(archive, name, np.dtype(dtype), (self.count, *shape), rows)
            for name, table in (dict(tables) | {"meta": meta_array}).items():
                add_member(archive, name, table.dtype, table.shape, table.tobytes())
        shutil.rmtree(self.folder, ignore_errors=True)

    def _put(self, name: str, index: Int[np.ndarray, " B"], values: np.ndarray) -> None:
        # Not through a memory map: where the disk is full, that ends the process without a word
        # (SIGBUS).
        dtype, shape = self._columns[name]
        rows = np.empty((len(index), *shape), dtype)
        rows[:] = values
        starts = np.flatnonzero(np.diff(index, prepend=-2) != 1)
        size = rows.nbytes // max(len(index), 1)
        path = self.folder / name
        with errors_name(path), open(path, "r+b") as handle:
            for start, stop in pairwise([*starts, len(index)]):
                handle.seek(int(index[start]) * size)
                handle.write(rows[start:stop].tobytes())

    def _map(self, name: str) -> np.memmap:
        # Mapped anew for each use: what a map has touched counts as the process's memory while it
        # is open.
        dtype, shape = self._columns[name]
        return np.memmap(self.folder / name, dtype, "r+", shape=(self.count, *shape))
