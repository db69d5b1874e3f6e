"""What a test run measured, whatever the problem: the content of metrics.json."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

FORMAT_VERSION = 1

Number = float | None
"""None where nothing could be measured."""


@dataclass(frozen=True)
class TestRun:
    """What was tested, on which data, and where the model comes from."""

    __test__ = False  # not one for pytest

    data: str | None
    source: str | None
    """``synthetic``, or where the real data are."""
    split: str | None
    frames: int
    seed: int | None
    provenance: Mapping[str, Any]
    """Plain data: version, commit, checkpoint, and those of the training."""
    problem: str | None = None

    @staticmethod
    def from_meta(meta: Mapping[str, Any], frames: int) -> TestRun:
        """Return what the meta data of predictions, or a metrics.json, say."""
        return TestRun(
            data=meta.get("data"),
            source=meta.get("source"),
            split=meta.get("split"),
            frames=frames,
            seed=meta.get("seed"),
            provenance=meta.get("provenance") or {},
            problem=meta.get("problem"),
        )

    @property
    def training(self) -> tuple[str | None, str | None]:
        """Name and source of the data that the model was trained on."""
        training = self.provenance.get("training") or {}
        return training.get("data"), training.get("source")


class Estimated(Protocol):
    """The numbers of one selection or baseline."""

    @property
    def headline(self) -> Number:
        """The one that sums it up, mm."""

    def plain(self) -> dict[str, Any]:
        """Return all numbers as plain data."""


S = TypeVar("S", bound=Estimated, covariant=True)


@dataclass(frozen=True)
class Measured(Generic[S]):
    """The numbers of each selection and baseline of a test run."""

    run: TestRun
    selections: Mapping[str, S]

    def plain(self) -> dict[str, Any]:
        """Return the content of metrics.json."""
        run = self.run
        return {
            "format_version": FORMAT_VERSION,
            "data": run.data,
            "source": run.source,
            "split": run.split,
            "problem": run.problem,
            "frames": run.frames,
            **self._own(),
            "seed": run.seed,
            "provenance": dict(run.provenance),
            "selections": {name: numbers.plain() for name, numbers in self.selections.items()},
        }

    def _own(self) -> dict[str, Any]:
        """Return what this problem's metrics.json says beside that."""
        return {}
