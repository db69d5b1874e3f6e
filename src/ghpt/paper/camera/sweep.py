"""The action of the sweep over the number of frames: errors of one M, draw by draw."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any

import torch

from ghpt.config import Target, build, settings
from ghpt.files import write_json
from ghpt.models.checkpoint import LAST, load_model
from ghpt.models.collect import CollectPredictions
from ghpt.models.predictions import open_predictions
from ghpt.models.relative_pose.evaluation import errors_of_pair, pair_name
from ghpt.models.relative_pose.schema import PAIRS


@dataclass(frozen=True)
class DrawsSettings:
    """The settings of `errors_of_draws`."""

    data: Target
    camera_baselines: Mapping[str, Target]
    frames: int
    """Frames of a draw."""
    draws: int
    """Draws of each rig."""
    pairs: Sequence[tuple[int, int]] | None
    """Pairs of the views, counted from 1; None: all."""
    seed: int
    hypotheses: int | None
    files: Mapping[str, Any] = field(default_factory=dict)
    """What identifies the files of a real data set."""


@torch.no_grad()
def errors_of_draws(config: dict[str, Any], dependencies: dict[str, Path], folder: Path) -> None:
    """Test the camera model of the dependency ``model`` on draws of frames of each rig.

    See `DrawsSettings`. result.json: pair -> selection or baseline -> E_3D (mm, null where a draw
    was not estimated) of each draw; beside it predictions.npz.
    """
    own = settings(DrawsSettings, config)
    changes: dict[str, Any] = {
        "problem.frames": own.frames,
        "problem.draws": own.draws,
        "seed": own.seed,
        "hypotheses": own.hypotheses,
    }
    model = load_model(dependencies["model"] / LAST, **changes)[0].eval()
    data = build(own.data, "data")
    data.bind(model.problem)
    data.setup("test")
    dataset = data.frames["test"]
    views = range(1, len(dataset.rigs[0].names) + 1)
    chosen = own.pairs or combinations(views, 2)
    dataset.pairs = [(a - 1, b - 1) for a, b in chosen]
    origin = {"data": data.name, "source": data.source, "split": data.evaluate}
    baselines = build(own.camera_baselines, "camera_baselines")
    meta = {**origin, "seed": own.seed}
    collect = CollectPredictions(folder, model.problem, baselines, meta)
    collect.open(dataset)
    for first in range(0, len(dataset), data.batch_size):
        batch = dataset[range(first, min(first + data.batch_size, len(dataset)))]
        collect.write(batch, model.test_step(batch, 0))
    collect.finish()
    predictions = open_predictions(collect.path, PAIRS)
    result = {}
    for pair in dataset.pairs:
        errors = errors_of_pair(predictions, pair, "E_3D")
        result[pair_name(pair)] = {name: _finite(values) for name, values in errors.items()}
    write_json(folder / "result.json", result)


def _finite(values: Sequence[float]) -> list[float | None]:
    """Return the values, None for those that are not finite."""
    return [value if math.isfinite(value) else None for value in values]
