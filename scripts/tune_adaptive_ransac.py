"""Choose ``adapt`` and ``quantile`` of adaptive RANSAC on validation data.

    python scripts/tune_adaptive_ransac.py

Prints its pelvis-relative MPJPE on the synthetic validation splits, as they are and perturbed, and
the geometric mean over all, by which conf/baselines are chosen. Test data are never looked at.
"""

import argparse
import itertools
import math
from pathlib import Path

import hydra
import torch
from rich.console import Console
from rich.progress import track
from rich.table import Column, Table

from ghpt.config import build, plain
from ghpt.metrics.pose_error import joint_errors
from ghpt.models.estimators.classical import Linear
from ghpt.models.estimators.ransac import AdaptiveRansac
from ghpt.paper.robustness.perturbation import (
    MissingDetections,
    Noise,
    Outliers,
    RotatedCameras,
    ShiftedCameras,
)

CONF = Path(__file__).resolve().parents[1] / "conf"
STRIDES = {"h36m": 256, "cmu3": 512}
CONSENSUS = list(itertools.product((0.5, 0.55, 0.6), (4.0, 5.0)))
CONDITIONS = {
    "as is": lambda batch, seed: batch,
    "5 % out": Outliers(0.05, 0.1, 0.5),
    "10 % out": Outliers(0.1, 0.1, 0.5),
    "20 % out": Outliers(0.2, 0.1, 0.5),
    "30 % out": Outliers(0.3, 0.1, 0.5),
    "noise": Noise(0.01),
    "30 % miss": MissingDetections(0.3),
    "40 % miss": MissingDetections(0.4),
    "0.5 deg": RotatedCameras(0.5),
    "1 deg": RotatedCameras(1.0),
    "2 deg": RotatedCameras(2.0),
    "20 mm": ShiftedCameras(20.0),
    "100 mm": ShiftedCameras(100.0),
}


def validation_batches(name: str) -> list:
    words = [
        f"data={name}",
        "data.evaluate=validation",
        f"data.stride={STRIDES[name]}",
        "output=none",
    ]
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        config = plain(hydra.compose("train", words))
    data = build(config["data"], "data")
    data.setup("test")
    return list(data.test_dataloader())


def error(estimator, batches: list, condition) -> float:
    total = count = 0.0
    for batch in batches:
        estimate = estimator(condition(batch.observations, 0))
        errors, counted = joint_errors(estimate, batch.truth, "relative")
        total, count = total + errors.sum().item(), count + counted.sum().item()
    return total / count


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.parse_args()
    torch.set_num_threads(2)
    batches = {name: validation_batches(name) for name in STRIDES}
    estimators = [("linear", Linear())]
    for quantile, adapt in CONSENSUS:
        settings = {
            "threshold": 0.02,
            "pairs": 24,
            "seed": 0,
            "adapt": adapt,
            "quantile": quantile,
            "rounds": 4,
        }
        robust = AdaptiveRansac(**settings)
        estimators.append((f"RANSAC, quantile {quantile:g}, adapt {adapt:g}", robust))
    columns = [
        Column("estimator", no_wrap=True),
        "mean",
        *(f"{name} {c}" for name in STRIDES for c in CONDITIONS),
    ]
    table = Table(*columns)
    for name, estimator in track(estimators):
        errors = [
            error(estimator, batches[data], c) for data in STRIDES for c in CONDITIONS.values()
        ]
        mean = math.exp(sum(map(math.log, errors)) / len(errors))
        table.add_row(name, f"{mean:.2f}", *(f"{e:.2f}" for e in errors))
    Console(width=260).print(table)


if __name__ == "__main__":
    main()
