"""metrics.json of a problem that has no metrics of its own: the mean error of each estimator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from ghpt.models.measured import Measured, Number, TestRun
from ghpt.models.predictions import Predictions

_CHUNK = 2048

Error = Callable[[Any, Any], tuple[Tensor, Tensor]]
"""A problem's ``error``."""


@dataclass(frozen=True)
class MeanError:
    """The mean over the samples that can be compared with a truth."""

    error: Number
    """mm."""
    coverage: float
    """Share of such samples."""

    @property
    def headline(self) -> Number:
        return self.error

    def plain(self) -> dict[str, Any]:
        """Return the numbers as plain data."""
        return {"error": self.error, "coverage": self.coverage}


def mean_errors(predictions: Predictions[Any, Any, Any], error: Error) -> Measured[MeanError]:
    """Return what a test run measured, from predictions that store the true joints."""
    total = dict.fromkeys(predictions.names, 0.0)
    compared = dict.fromkeys(predictions.names, 0)
    for chunk in predictions.chunks(_CHUNK):
        truth = chunk.sample.as_truth()
        for name, estimate in chunk.estimates.items():
            errors, has_truth = error(estimate, truth)
            total[name] += float(errors[has_truth].double().sum())
            compared[name] += int(has_truth.sum())
    selections = {}
    for name, count in compared.items():
        mean = total[name] / count if count else None
        selections[name] = MeanError(mean, count / len(predictions))
    return Measured(TestRun.from_meta(predictions.meta, len(predictions)), selections)
