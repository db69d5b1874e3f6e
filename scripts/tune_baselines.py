"""Choose the classical estimators' thresholds on validation data: ``python
scripts/tune_baselines.py``.

Prints the pelvis-relative MPJPE of each estimator for each threshold (a fraction of the person's
size in the image) on the synthetic validation splits; conf/baselines/default.yaml holds the best on
Human3.6M. Test data are never looked at.
"""

import itertools
from pathlib import Path

import hydra
import torch
from rich.console import Console
from rich.progress import track
from rich.table import Table

from ghpt.config import build, plain
from ghpt.metrics.pose_error import joint_errors
from ghpt.models.estimators.classical import MEstimator, WeightedLinear
from ghpt.models.estimators.lo_ransac import LoRansac
from ghpt.models.estimators.ransac import Ransac

CONF = Path(__file__).resolve().parents[1] / "conf"
GRID = (0.005, 0.0075, 0.01, 0.015, 0.02, 0.03, 0.04, 0.06)
ESTIMATORS = {
    "ransac": lambda x: Ransac(threshold=x, pairs=64, seed=0),
    "lo_ransac": lambda x: LoRansac(threshold=x, seed=0),
    **{
        f"m_estimator {loss}": lambda x, loss=loss: MEstimator(
            loss=loss, scale=x, iterations=10, tolerance=1.0
        )
        for loss in ("huber", "cauchy", "geman_mcclure")
    },
    "weighted_linear (power = 100 x)": lambda x: WeightedLinear(power=100 * x),
}


def validation_batches(name: str) -> list:
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        config = plain(
            hydra.compose("train", [f"data={name}", "data.evaluate=validation", "output=none"])
        )
    data = build(config["data"], "data")
    data.setup("test")
    return list(data.test_dataloader())


def error(estimator, batches: list) -> float:
    total = count = 0.0
    for batch in batches:
        errors, counted = joint_errors(estimator(batch.observations), batch.truth, "relative")
        total, count = total + errors.sum().item(), count + counted.sum().item()
    return total / count


def main() -> None:
    torch.set_num_threads(2)
    for name in ("h36m", "cmu3"):
        batches = validation_batches(name)
        table = Table(
            "estimator",
            *map(str, GRID),
            title=f"validation split of synthetic {name}: relative MPJPE, mm",
        )
        cells = {
            (e, x): error(ESTIMATORS[e](x), batches)
            for e, x in track(list(itertools.product(ESTIMATORS, GRID)), description=name)
        }
        for e in ESTIMATORS:
            best = min(cells[e, x] for x in GRID)
            table.add_row(
                e,
                *(f"[bold]{v:.2f}[/]" if (v := cells[e, x]) == best else f"{v:.2f}" for x in GRID),
            )
        Console(width=120).print(table)


if __name__ == "__main__":
    main()
