"""The tasks and numbers that the camera problem's tables and figure share."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from ghpt.paper.engine.artefact import Results, Spread
from ghpt.paper.engine.setup import Setup
from ghpt.paper.engine.tasks import Task
from ghpt.paper.published import FUNDAMENTAL, FUNDAMENTAL_FRAMES

PAIRS = tuple(f"{a}-{b}" for a, b in FUNDAMENTAL)
"""The pairs of Human3.6M's cameras, in the paper's order."""


def camera_model(setup: Setup) -> Task:
    """Return the training of the paper's model, on Human3.6M."""
    return setup.training("h36m", model="camera", seconds=100.0)


def common_settings(composed: Mapping[str, Any]) -> dict[str, Any]:
    """Return what every test depends on, out of test.py's whole configuration."""
    names = ("data", "seed", "hypotheses", "files")
    return {name: composed[name] for name in names if name in composed}


def pair_tests(setup: Setup) -> dict[str, Task]:
    """Return the test of the camera model on Human3.6M with all classical estimators."""
    model = camera_model(setup)
    return {"test": setup.test(model, "h36m", f"frames={FUNDAMENTAL_FRAMES}", seconds=75.0)}


def pair_error(results: Results, method: str, pair: str, *keys: str) -> Spread:
    """Return a number of a pair in metrics.json over the seeds, inf where it was not measured."""
    numbers = results.numbers("test", "selections", method, "pairs", pair, *keys)
    return Spread(tuple(math.inf if number is None else number for number in numbers))


def rescale(spread: Spread, factor: float = 1.0) -> Spread | None:
    """Return the number in another unit, None where it is not finite."""
    if not math.isfinite(spread.mean):
        return None
    return Spread(tuple(factor * value for value in spread.values))
