"""The work of the ablations: a model's selections on several sets of frames, at several pool sizes
and temperatures.
"""

from pathlib import Path
from typing import Any

import torch

from ghpt.config import build
from ghpt.data.datasets.frames import Frames
from ghpt.files import write_json
from ghpt.metrics.pose_error import MPJPE
from ghpt.models.checkpoint import LAST, load_model
from ghpt.models.module import StochasticEstimator
from ghpt.skeleton import JOINTS

AGGREGATIONS = ("weight", "average", "best")


@torch.no_grad()
def evaluate(config: dict[str, Any], dependencies: dict[str, Path], folder: Path) -> None:
    """Test the model of ``dependencies["model"]`` on each data module of ``config["sets"]`` under each of
    ``config["settings"]``, pairs of a number of hypotheses and a temperature (None: the model's
    own).

    result.json: set -> for each setting selection -> pelvis-relative MPJPE (mm). A smaller pool is
    the beginning of a larger one, the same that test.py draws with so many hypotheses.
    """
    model, _ = load_model(dependencies["model"] / LAST, seed=config["seed"])
    model.eval()
    settings = [(h or model.hypotheses, t or model.temperature) for h, t in config["settings"]]
    result = {}
    for name, set_of_frames in config["sets"].items():
        data = build(set_of_frames, "data")
        data.setup("test")
        result[name] = errors(model, data.frames["test"], settings, data.batch_size)
    write_json(folder / "result.json", result)


def errors(
    model: StochasticEstimator, frames: Frames, settings: list[tuple[int, float]], batch_size: int
) -> list[dict[str, float]]:
    """Pelvis-relative MPJPE (mm) of the selections under each setting."""
    metrics = [{name: MPJPE("relative", 1, len(JOINTS)) for name in AGGREGATIONS} for _ in settings]
    model.hypotheses = max(count for count, _ in settings)
    for first in range(0, len(frames), batch_size):
        batch = frames[range(first, min(first + batch_size, len(frames)))]
        pool = model.sample(batch.observations, "test", batch.truth)
        for each, (count, temperature) in zip(metrics, settings, strict=True):
            part = pool.first(count).with_temperature(temperature)
            for name, metric in each.items():
                group = torch.zeros_like(batch.observations.index)
                metric.update(part.estimate(name), batch.truth, group)
    return [
        {name: metric.compute().mean.item() for name, metric in each.items()} for each in metrics
    ]
