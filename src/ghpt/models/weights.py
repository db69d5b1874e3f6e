"""Weights of small models that come with the package: arrays and plain text, never code."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ghpt.errors import GhptConfigError
from ghpt.files import atomic_write
from ghpt.models.module import StochasticEstimator
from ghpt.models.registry import build_registered

_FOLDER = "weights"
_META = "meta"


@cache
def load_shipped(name: str) -> StochasticEstimator:
    """Return a model that the package carries, ready to use, on the CPU.

    Raises GhptConfigError for a name that it has not.
    """
    folder = resources.files("ghpt") / _FOLDER
    file = folder / f"{name}.npz"
    if not file.is_file():
        existing = sorted(path.name.removesuffix(".npz") for path in folder.iterdir())
        known = ", ".join(name for name in existing if "." not in name)
        raise GhptConfigError("weights", f"there is no {name!r}", f"Existing: {known}.")
    with file.open("rb") as handle, np.load(handle, allow_pickle=False) as arrays:
        config = json.loads(str(arrays[_META]))["model"]
        state = {key: torch.from_numpy(arrays[key]) for key in arrays.files if key != _META}
    model: StochasticEstimator = build_registered(config)
    model.scorer.load_state_dict(state)
    return model.eval()


def write_weights(model: StochasticEstimator, trained: Mapping[str, Any], path: Path) -> None:
    """Write a model's weights and where they are from, as ``load_shipped`` reads them.

    ``trained``: what the checkpoint says of itself (``load_model``).
    """
    about = {"model": trained["config"]["model"], "provenance": trained["provenance"]}
    state = model.scorer.state_dict()
    arrays: dict[str, Any] = {key: value.cpu().numpy() for key, value in state.items()}
    arrays[_META] = np.array(json.dumps(about))
    with atomic_write(path) as handle:
        np.savez(handle, **arrays)
