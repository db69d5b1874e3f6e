"""metrics.json of a problem that has no metrics of its own: the mean error of each estimator."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor

from ghpt.models.predictions import Predictions

FORMAT_VERSION = 1
_CHUNK = 2048

Error = Callable[[Any, Any], tuple[Tensor, Tensor]]
"""A problem's ``error``."""


def mean_errors(predictions: Predictions[Any, Any, Any], error: Error) -> dict[str, Any]:
    """Return the content of metrics.json, from predictions that store the true joints.

    ``selections[name]``: ``error``, the mean over the samples that can be compared with a truth
    (mm, null where none can), and ``coverage``, their share of all samples.
    """
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
        selections[name] = {"error": mean, "coverage": count / len(predictions)}
    meta = predictions.meta
    return {
        "format_version": FORMAT_VERSION,
        **{key: meta.get(key) for key in ("data", "source", "split", "problem")},
        "frames": len(predictions),
        **{key: meta.get(key) for key in ("seed", "provenance")},
        "selections": selections,
    }
