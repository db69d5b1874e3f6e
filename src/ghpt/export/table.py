"""poses.csv and poses.parquet: one row for each frame."""

from __future__ import annotations

import csv
import json
from dataclasses import asdict
from io import StringIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from ghpt.errors import GhptConfigError
from ghpt.export.stream import Chunks, pieces, plain_names, text_rows
from ghpt.files import atomic_write
from ghpt.reconstruction import FILE_STATES, About, Reconstruction, State

_STATES = np.array([state.name.lower() for state in FILE_STATES])


class Column(NamedTuple):
    """One column; a number that is NaN, and a text that is empty, is missing."""

    name: str
    values: np.ndarray
    form: str
    """How its numbers are written: 9 digits give back a float32 exactly, 6 decimals a nanometre."""


def columns(path: Path, about: About, piece: Reconstruction) -> list[Column]:
    """frame, time_s and score; then for each joint its position x_mm y_mm z_mm, state, error_px
    (reprojection), views (how many made it) and spread_mm, the root of the covariance's trace.
    """
    rate = about.rate_hz if about.rate_hz else np.nan
    observed = piece.state == State.OBSERVED
    placed = piece.has_position
    points = torch.where(placed[..., None], piece.points, torch.nan).numpy()
    error = torch.where(observed, piece.error, torch.nan).numpy()
    spread = torch.where(
        observed, piece.covariance[..., [0, 3, 5]].sum(-1).clamp(min=0).sqrt(), torch.nan
    ).numpy()
    counts = piece.views.sum(1).numpy().astype(np.int32)
    states = _STATES[piece.state.numpy()]
    frame = piece.frame.numpy()
    found = [
        Column("frame", frame, "%d"),
        Column("time_s", frame / rate, "%.9g"),
        Column("score", piece.score.numpy(), "%.9g"),
    ]
    for j, joint in enumerate(plain_names(path, "joints", about.joints)):
        position = [(f"{joint}_{axis}_mm", points[:, j, i]) for i, axis in enumerate("xyz")]
        found += [Column(name, values, "%.6f") for name, values in position]
        found += [
            Column(f"{joint}_state", states[:, j], ""),
            Column(f"{joint}_error_px", error[:, j], "%.9g"),
            Column(f"{joint}_views", counts[:, j], "%d"),
            Column(f"{joint}_spread_mm", spread[:, j], "%.9g"),
        ]
    return found


def write_csv(path: Path, about: About, chunks: Chunks) -> None:
    """A row for each frame under a row of names; commas, decimal points, UTF-8; what is missing is
    an empty cell.
    """
    with atomic_write(path, "w") as handle:
        named = False
        for piece in pieces(path, about, chunks):
            table = columns(path, about, piece)
            if not named:
                line = StringIO()
                csv.writer(line, lineterminator="\n").writerow(column.name for column in table)
                handle.write(line.getvalue())
                named = True
            texts = np.array([not column.form for column in table])
            numbers = np.array(
                [np.zeros(len(piece)) if t else c.values for c, t in zip(table, texts, strict=True)]
            ).T
            there = ~np.isnan(numbers) & ~texts
            cells = np.where(there, np.array([column.form for column in table]), "").astype(object)
            cells[:, texts] = np.array([column.values for column in table if not column.form]).T
            handle.write(text_rows(cells, numbers[there], ",", "\n"))


def write_parquet(path: Path, about: About, chunks: Chunks) -> None:
    """The same columns as in the CSV file; what is missing is null; the rest of ``About`` is the
    schema's metadata.

    Raises GhptConfigError without pyarrow.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise GhptConfigError(
            "parquet", "needs pyarrow", "pip install 'ghpt[io]', or leave parquet out"
        ) from error
    notes = {"ghpt": json.dumps(asdict(about) | {"unit": "mm"}, allow_nan=False)}
    writer = None
    with atomic_write(path) as handle:
        for piece in pieces(path, about, chunks):
            table = columns(path, about, piece)
            arrays = [
                pa.array(c.values, mask=np.isnan(c.values) if c.form else None) for c in table
            ]
            batch = pa.table(
                arrays, names=[column.name for column in table]
            ).replace_schema_metadata(notes)
            writer = writer or pq.ParquetWriter(handle, batch.schema)
            writer.write_table(batch)
        if writer is not None:
            writer.close()
