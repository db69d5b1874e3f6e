"""What a prediction ends in, as prediction.json holds it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from ghpt.commands.prediction.statistics import Coverage, Evaluation, ScaledErrors
from ghpt.commands.prediction.verdict import Verdict


@dataclass(frozen=True)
class PersonSummary:
    """One of several people, in the order of their folders."""

    observed: float
    """Share of the joints that are observed, over all frames of the recording."""
    stature_mm: float | None
    verdict: str


@dataclass(frozen=True)
class PredictionResult:
    """What prediction.json holds."""

    data: str
    source: str
    cameras: tuple[str, ...]
    estimator: str
    estimator_text: str
    rate_hz: float | None
    fill_frames: int | None
    smooth_hz: float | None
    coverage: Coverage
    scales: ScaledErrors
    unit_mm: float
    evaluation: Evaluation
    formats: list[str]
    world: dict[str, Any]
    """The world of the files, and the way there from that of the cameras."""
    provenance: dict[str, Any]
    verdict: Verdict | None = None
    people: tuple[PersonSummary, ...] = ()
    """All of several people, in the first person's result."""

    def plain(self) -> dict[str, Any]:
        """Return the result as plain data; the coverage is not a group of its own."""
        values: dict[str, Any] = {}
        for key, value in asdict(self).items():
            if key == "coverage":
                values |= value
            elif key == "verdict":
                values |= {key: self.verdict.numbers()} if self.verdict else {}
            else:
                values[key] = value
        return values
