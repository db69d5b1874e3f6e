"""The work of the sweep over the number of frames: errors of one M, draw by draw."""

import math
from itertools import combinations
from pathlib import Path
from typing import Any

import torch

from ghpt.config import build
from ghpt.files import write_json
from ghpt.models.aggregation import AGGREGATIONS
from ghpt.models.checkpoint import LAST, load_model
from ghpt.models.collect import CollectPairs
from ghpt.models.relative_pose.evaluation import errors_of_pair, pair_name
from ghpt.models.relative_pose.predictions import open_pairs


def errors_of_draws(config: dict[str, Any], dependencies: dict[str, Path], folder: Path) -> None:
    """Test the camera model of ``dependencies["model"]`` on ``draws`` draws of ``frames`` frames of each
    rig.

    ``pairs``: of views, counted from 1; None: all. result.json: pair -> selection or baseline ->
    E_3D (mm, null where a draw was not estimated) of each draw; beside it predictions.npz.
    """
    changes = {"problem.frames": config["frames"], "problem.draws": config["draws"]}
    changes |= {"seed": config["seed"], "hypotheses": config["hypotheses"]}
    model = load_model(dependencies["model"] / LAST, **changes)[0].eval()
    data = build(config["data"], "data")
    data.bind(model.problem)
    data.setup("test")
    pairs = data.frames["test"]
    views = len(pairs.rigs[0].names)
    pairs.pairs = [
        (a - 1, b - 1) for a, b in config["pairs"] or combinations(range(1, views + 1), 2)
    ]
    meta = {
        "data": data.name,
        "source": data.source,
        "split": data.evaluate,
        "seed": config["seed"],
    }
    collect = CollectPairs(folder, build(config["camera_baselines"], "camera_baselines"), meta)
    collect.data = pairs
    collect.open([*AGGREGATIONS, *collect.estimators])
    with torch.no_grad():
        for first in range(0, len(pairs), data.batch_size):
            batch = pairs[range(first, min(first + data.batch_size, len(pairs)))]
            collect.write(model, batch, model.test_step(batch, 0))
    collect.finish()
    predictions = open_pairs(collect.path)
    result = {
        pair_name(pair): {
            name: [value if math.isfinite(value) else None for value in values]
            for name, values in errors_of_pair(predictions, pair, "E_3D").items()
        }
        for pair in pairs.pairs
    }
    write_json(folder / "result.json", result)
