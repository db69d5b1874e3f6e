"""poses.csv and poses.parquet: one row for each frame."""

from __future__ import annotations

import csv
import json
from dataclasses import asdict, dataclass
from io import StringIO
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ghpt.errors import GhptConfigError
from ghpt.export.stream import Chunks, pieces, plain_names, text_rows
from ghpt.files import atomic_write
from ghpt.geometry.masking import where
from ghpt.reconstruction import FILE_STATES, About, Reconstruction

_STATES = np.array([state.name.lower() for state in FILE_STATES])


@dataclass(frozen=True)
class Column:
    """One column; a number that is NaN, and a text that is empty, is missing."""

    name: str
    values: np.ndarray
    form: str
    """How its numbers are written: 9 digits give back a float32 exactly, 6 decimals a nanometre.
    Empty for texts.
    """


def columns(path: Path, about: About, piece: Reconstruction) -> list[Column]:
    """Return frame, time_s and score; then the columns of each joint.

    These are its position x_mm y_mm z_mm, state, error_px (reprojection), views (how many made it)
    and spread_mm, the root of the covariance's trace.
    """
    rate = about.rate_hz if about.rate_hz else np.nan
    observed = piece.is_measured
    points = where(piece.has_position, piece.points, torch.nan).numpy()
    error = torch.where(observed, piece.error, torch.nan).numpy()
    spread = torch.where(observed, _spread(piece.covariance), torch.nan).numpy()
    counts = piece.views.sum(1).numpy().astype(np.int32)
    states = _STATES[piece.state.numpy()]
    frame = piece.frame.numpy()
    found = [
        Column("frame", frame, "%d"),
        Column("time_s", frame / rate, "%.9g"),
        Column("score", piece.score.numpy(), "%.9g"),
    ]
    for j, joint in enumerate(plain_names(path, "joints", about.joints)):
        found += [
            Column(f"{joint}_x_mm", points[:, j, 0], "%.6f"),
            Column(f"{joint}_y_mm", points[:, j, 1], "%.6f"),
            Column(f"{joint}_z_mm", points[:, j, 2], "%.6f"),
            Column(f"{joint}_state", states[:, j], ""),
            Column(f"{joint}_error_px", error[:, j], "%.9g"),
            Column(f"{joint}_views", counts[:, j], "%d"),
            Column(f"{joint}_spread_mm", spread[:, j], "%.9g"),
        ]
    return found


def _spread(covariance: Tensor) -> Tensor:
    """Return the root of the trace of covariances xx xy xz yy yz zz."""
    trace = covariance[..., [0, 3, 5]].sum(-1)
    return trace.clamp(min=0).sqrt()


def write_csv(path: Path, about: About, chunks: Chunks) -> None:
    """Write a row for each frame under a row of names; what is missing is an empty cell.

    Commas, decimal points, UTF-8.
    """
    with atomic_write(path, "w") as handle:
        has_names = False
        for piece in pieces(path, about, chunks):
            table = columns(path, about, piece)
            if not has_names:
                handle.write(_name_row(table))
                has_names = True
            handle.write(_rows(table))


def _name_row(table: list[Column]) -> str:
    line = StringIO()
    writer = csv.writer(line, lineterminator="\n")
    writer.writerow(column.name for column in table)
    return line.getvalue()


def _rows(table: list[Column]) -> str:
    forms = np.array([column.form for column in table])
    is_text = forms == ""
    nothing = np.zeros(len(table[0].values))
    numbers = np.array([column.values if column.form else nothing for column in table]).T
    texts = np.array([column.values for column in table if not column.form]).T
    present = ~np.isnan(numbers) & ~is_text
    cells = np.where(present, forms, "").astype(object)
    cells[:, is_text] = texts
    return text_rows(cells, numbers[present], ",", "\n")


def write_parquet(path: Path, about: About, chunks: Chunks) -> None:
    """Write the same columns as in the CSV file; what is missing is null.

    The rest of ``About`` is the schema's metadata. Raises GhptConfigError without pyarrow.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        hint = "Install it (pip install pyarrow), or leave parquet out."
        raise GhptConfigError("parquet", "needs pyarrow", hint) from error
    notes = json.dumps(asdict(about) | {"unit": "mm"}, allow_nan=False)
    writer = None
    with atomic_write(path) as handle:
        for piece in pieces(path, about, chunks):
            table = columns(path, about, piece)
            names = [column.name for column in table]
            arrays = []
            for column in table:
                missing = np.isnan(column.values) if column.form else None
                arrays.append(pa.array(column.values, mask=missing))
            batch = pa.table(arrays, names=names).replace_schema_metadata({"ghpt": notes})
            writer = writer or pq.ParquetWriter(handle, batch.schema)
            writer.write_table(batch)
        if writer is not None:
            writer.close()
