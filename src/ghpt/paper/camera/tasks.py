"""The tasks and numbers that the camera problem's tables and figure share."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ghpt.paper.engine.artefact import Comparison, Results, Spread
from ghpt.paper.engine.setup import Setup
from ghpt.paper.engine.tasks import Task
from ghpt.paper.published import FUNDAMENTAL_FRAMES


def camera_model(setup: Setup) -> Task:
    """The paper's: trained on Human3.6M."""
    return setup.trained("h36m", model="camera", seconds=100.0)


def of_test(composed: Mapping[str, Any]) -> dict[str, Any]:
    """What every test depends on, out of test.py's whole configuration."""
    return {
        key: composed[key] for key in ("data", "seed", "hypotheses", "files") if key in composed
    }


def tested_pairs(setup: Setup) -> dict[str, Task]:
    """The camera model on Human3.6M with all classical estimators."""
    return {
        "test": setup.tested(
            camera_model(setup), "h36m", f"frames={FUNDAMENTAL_FRAMES}", seconds=75.0
        )
    }


def of_pair(results: Results, method: str, pair: str, *keys: str) -> Spread:
    """A number of metrics.json over the seeds; inf where it could not be measured."""
    values = []
    for content in results.read("test", "metrics.json"):
        for key in ("selections", method, "pairs", pair, *keys):
            content = content[key]
        values.append(math.inf if content is None else float(content))
    return Spread(tuple(values))


def measured(spread: Spread, times: float = 1.0) -> Spread | None:
    """The number in another unit; None where it is not finite."""
    return (
        Spread(tuple(times * value for value in spread.values))
        if math.isfinite(spread.mean)
        else None
    )


def three_rows(pair: str, numbers: Sequence[Comparison], more: Sequence[str]) -> list[list[str]]:
    """Rows *paper*, *ours* and *difference* of a pair; ``more`` is what else there is of ours."""
    kinds = zip(
        ("paper", "ours", "difference"),
        zip(*(n.cells() for n in numbers), strict=True),
        strict=True,
    )
    return [
        [f"{pair} {kind}", *cells, *(more if kind == "ours" else [""] * len(more))]
        for kind, cells in kinds
    ]
