"""predictions.npz: what every estimator makes of every sample of a test run.

A test writes this file first; all numbers, tables and figures come from it. A problem's ``Schema``
says what its file holds, and nothing here knows more of a problem than that.
"""

from __future__ import annotations

import json
import math
import re
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.data.formats.stored_npz import Member, members_of, read_rows, text_table
from ghpt.errors import GhptDataError, GhptError
from ghpt.models.aggregation import WeightSummary
from ghpt.models.rows import Column, Layout, RowWriter
from ghpt.observations import Batch, Estimate, Truth, expand_mask
from ghpt.skeleton import JOINTS

FORMAT_VERSION = 1
_HINT = "Run the test again to make it anew"
_NAME = re.compile("[a-z][a-z0-9_]*")

RowT = TypeVar("RowT", bound=Batch)
EstimateT = TypeVar("EstimateT", bound=Estimate)
SampleT = TypeVar("SampleT", bound=Batch)
TablesT = TypeVar("TablesT", bound="Tables")


class InvalidArray(ValueError):
    """An array of a predictions file does not fit the others."""

    def __init__(self, array: str, problem: str) -> None:
        super().__init__(f"{array}: {problem}")
        self.array = array
        self.problem = problem


@dataclass(frozen=True)
class Record(Generic[RowT]):
    """A batch that a file holds: its class, and the column of each of its fields."""

    cls: type[RowT]
    columns: Layout


@dataclass(frozen=True)
class Tables:
    """Arrays that a file holds once. A problem's own ones are the fields of a derived class."""

    dtypes: ClassVar[Mapping[str, str]] = {}
    """Data type of each array; ``U`` is text."""

    def check(self) -> None:
        """Raise InvalidArray unless the tables belong together."""

    def check_sample(self, sample: Any) -> None:
        """Raise InvalidArray if a sample names what is not in the tables."""


_SUMMARY = Record(WeightSummary, {field.name: ("<f4", ()) for field in fields(WeightSummary)})


@dataclass(frozen=True)
class TrueJoints(Batch):
    """The true joints of the samples, as a file holds them."""

    truth: Float[Tensor, "B J 3"]
    """World frame, mm; NaN where ``truth_seen`` is False."""
    truth_seen: Bool[Tensor, "B J"]

    @staticmethod
    def from_truth(truth: Truth) -> TrueJoints:
        """Return the true poses as they are stored."""
        return TrueJoints(with_nan(truth), truth.valid)

    def as_truth(self) -> Truth:
        """Return the true poses; a joint that is not finite has none."""
        valid = self.truth_seen & self.truth.isfinite().all(-1)
        return Truth(torch.where(valid[..., None], self.truth, 0.0), valid)


def with_nan(truth: Truth) -> Float[Tensor, "B J 3"]:
    """Return the true points, NaN where they are not valid."""
    return truth.points.masked_fill(~truth.valid[..., None], torch.nan)


TRUE_JOINTS = Record(
    TrueJoints,
    {"truth": ("<f4", (len(JOINTS), 3)), "truth_seen": ("|b1", (len(JOINTS),))},
)


@dataclass(frozen=True)
class Schema(Generic[EstimateT, SampleT, TablesT]):
    """What the predictions file of a problem holds."""

    problem: str
    """Name of the problem, by which a file of another one is refused."""
    estimate: Record[EstimateT]
    """What is stored of every aggregation and baseline: ``<field>_<name>``."""
    sample: Record[SampleT]
    """What is stored of each sample once: ``<field>``."""
    tables: type[TablesT]

    def layout(self, names: Sequence[str]) -> Layout:
        """Return the columns of a file with estimates of these names."""
        columns: Layout = {}
        for name in names:
            columns |= _with_names(self.estimate, "{field}_" + name)
        return columns | self.sample.columns | _with_names(_SUMMARY, "weights_{field}")


def frame_schema(
    problem: str, estimate: type[EstimateT], columns: Layout
) -> Schema[EstimateT, TrueJoints, Tables]:
    """Return the schema of a problem of frames: beside its estimates, the frames' true joints."""
    return Schema(problem, Record(estimate, columns), TRUE_JOINTS, Tables)


def _with_names(record: Record[Any], template: str) -> dict[str, Column]:
    return {template.format(field=name): column for name, column in record.columns.items()}


class PredictionWriter:
    """Writes the samples of a test run. Several processes may, each a part of the samples.

    ``names``: the aggregations and baselines. Every process opens the same new ``folder``; after
    all have written, one calls ``finish``.
    """

    def __init__(
        self, folder: str | Path, count: int, names: Sequence[str], schema: Schema[Any, Any, Any]
    ) -> None:
        if count < 1 or not names or not all(map(_NAME.fullmatch, names)):
            names = list(names)
            raise GhptError(f"predictions of {count} samples of {names}: need one and plain names")
        self.names = tuple(names)
        self.schema = schema
        self._rows = RowWriter(folder, count, schema.layout(names))

    def write(
        self,
        index: Int[Tensor, " B"],
        estimates: Mapping[str, Estimate],
        sample: Batch,
        weights: WeightSummary,
    ) -> None:
        """Write samples to their rows. An estimate that is not ``valid`` becomes NaN."""
        if set(estimates) != set(self.names):
            raise GhptError(f"got {[*estimates]}, not {[*self.names]}")
        values = {name: getattr(sample, name) for name in self.schema.sample.columns}
        values |= {f"weights_{name}": getattr(weights, name) for name in _SUMMARY.columns}
        for name, estimate in estimates.items():
            valid = estimate.valid()
            for field in self.schema.estimate.columns:
                value = getattr(estimate, field)
                missing = ~expand_mask(valid, value)
                stored = valid if field == "estimated" else value.masked_fill(missing, torch.nan)
                values[f"{field}_{name}"] = stored
        self._rows.write(index, values)

    def finish(self, path: str | Path, tables: Tables, meta: Mapping[str, Any]) -> None:
        """Make the file ``path``; ``meta`` says what it is of, as plain data.

        The same content gives the same bytes. Raises GhptError if a row is missing.
        """
        own = {"format_version": FORMAT_VERSION, "unit": "mm", "names": self.names}
        own |= {"problem": self.schema.problem}
        arrays = {field.name: getattr(tables, field.name) for field in fields(tables)}
        verify = lambda written: open_predictions(written, self.schema)  # noqa: E731
        self._rows.finish(path, arrays, own | dict(meta), verify)


@dataclass(frozen=True)
class Chunk(Generic[EstimateT, SampleT]):
    """Successive rows of a predictions file."""

    estimates: dict[str, EstimateT]
    """By the name of the aggregation or baseline; masked, without NaN."""
    sample: SampleT
    weights: WeightSummary


@dataclass(frozen=True)
class Predictions(Generic[EstimateT, SampleT, TablesT]):
    """An opened predictions file. Rows are read when they are asked for."""

    path: Path
    schema: Schema[EstimateT, SampleT, TablesT]
    meta: dict[str, Any]
    names: tuple[str, ...]
    """The aggregations, then the baselines."""
    tables: TablesT
    members: dict[str, Member]

    def __len__(self) -> int:
        return self.members["weights_max"].shape[0]

    def read(self, start: int, stop: int) -> Chunk[EstimateT, SampleT]:
        """Return the rows from ``start`` up to ``stop``.

        Raises GhptDataError if they name what is not in the tables.
        """
        sample = self._read(self.schema.sample, "{field}", start, stop)
        with _fitting(self.path):
            self.tables.check_sample(sample)
        estimates = {}
        for name in self.names:
            estimate = self._read(self.schema.estimate, "{field}_" + name, start, stop)
            estimates[name] = estimate.mask_invalid()
        return Chunk(estimates, sample, self._read(_SUMMARY, "weights_{field}", start, stop))

    def chunks(self, size: int) -> Iterator[Chunk[EstimateT, SampleT]]:
        """Yield all rows, ``size`` at a time."""
        for start in range(0, len(self), size):
            yield self.read(start, min(start + size, len(self)))

    def _read(self, record: Record[RowT], template: str, start: int, stop: int) -> RowT:
        values = {}
        for field in record.columns:
            member = self.members[template.format(field=field)]
            array = torch.from_numpy(read_rows(self.path, member, start, stop))
            whole = member.dtype.kind == "i"
            values[field] = array.long() if whole else array
        return record.cls(**values)


def open_predictions(
    path: str | Path, schema: Schema[EstimateT, SampleT, TablesT]
) -> Predictions[EstimateT, SampleT, TablesT]:
    """Open and check a predictions file; nothing in it is executed or unpacked.

    Raises GhptDataError if it is missing, damaged (every byte is compared with its checksum), of
    another version or another problem, or if its arrays do not belong together.
    """
    path = Path(path)
    with _readable(path):
        members = members_of(path)
        meta = json.loads(text_table(path, members, "meta")[0])
    names = _check_meta(path, meta, schema.problem)
    _check_columns(path, members, schema.layout(names))
    with _readable(path):
        arrays = {
            name: _read_table(path, members, name, schema.tables) for name in schema.tables.dtypes
        }
    tables = schema.tables(**arrays)
    with _fitting(path):
        tables.check()
    return Predictions(path, schema, meta, names, tables, members)


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Say what a file lacks that cannot be read."""
    try:
        yield
    except FileNotFoundError as error:
        raise GhptDataError(path, "", "there is no such file", "Run test.py first") from error
    except (OSError, ValueError, TypeError, EOFError, RuntimeError, zipfile.BadZipFile) as error:
        problem = f"is not a readable predictions file ({error})"
        raise GhptDataError(path, "", problem, _HINT) from error


@contextmanager
def _fitting(path: Path) -> Iterator[None]:
    """Say of which file an array is that does not fit."""
    try:
        yield
    except InvalidArray as error:
        raise GhptDataError(path, error.array, error.problem, _HINT) from error


def _check_meta(path: Path, meta: Any, problem: str) -> tuple[str, ...]:
    """Return the names of the estimates."""
    version = meta.get("format_version") if isinstance(meta, dict) else None
    if version != FORMAT_VERSION:
        text = f"is {version!r}; this ghpt reads {FORMAT_VERSION}"
        raise GhptDataError(path, "meta.format_version", text, _HINT)
    names = meta.get("names")
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise GhptDataError(path, "meta.names", "is not a list of aggregations", _HINT)
    found = meta.get("problem")
    if found != problem:
        raise GhptDataError(path, "meta.problem", f"is {found!r}, not {problem!r}", _HINT)
    return tuple(names)


def _check_columns(path: Path, members: Mapping[str, Member], layout: Layout) -> None:
    """Raise GhptDataError unless every array of the layout is there, with as many rows as all."""
    first = members.get("weights_max")
    count = first.shape[0] if first and first.shape else 0
    for name, (dtype, shape) in layout.items():
        if name not in members or members[name][1:] != (np.dtype(dtype), (count, *shape)):
            problem = f"is not {dtype} of shape {(count, *shape)}"
            raise GhptDataError(path, name, problem, _HINT)


def _read_table(
    path: Path, members: Mapping[str, Member], name: str, cls: type[Tables]
) -> np.ndarray:
    """Return an array of the tables. Raises ValueError if it is missing or of another type."""
    dtype = cls.dtypes[name]
    if dtype == "U":
        texts = text_table(path, members, name)
        return np.array(texts, dtype=np.str_).reshape(members[name].shape)
    member = members.get(name)
    if member is None or member.dtype != np.dtype(dtype) or not member.shape:
        raise ValueError(f"{name} is not an array of {dtype}")
    if not math.prod(member.shape):
        raise ValueError(f"{name} is empty")
    return read_rows(path, member, 0, member.shape[0])
