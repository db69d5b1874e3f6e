"""One whole training step beside the bare step of the same scorer: ``python
benchmarks/training_step.py``.

The whole step is Lightning's: frames from the memory-mapped store, random subsets, triangulation,
features, Gumbel weights, loss, backward, Adam, logging, and whatever the loop itself costs. The
bare step is forward, backward and Adam of an equal scorer on random features of the same size. They
take turns in one run, so that a busy machine slows both; the ratio is the median over pairs. The
mean of the whole step holds the checkpoints too.

Settings: ``views=4,7`` ``epochs=1`` ``progress_bar=1`` ``save_every=16`` (steps between
checkpoints).
"""

import copy
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any, ClassVar

import scene
import torch
from measure import configuration, machine, settings, show

from ghpt.commands.train import TrainSettings, train
from ghpt.config import settings as typed_settings
from ghpt.models.module import StochasticEstimator


class TimedEstimator(StochasticEstimator):
    """Takes a bare step after each of its own, and the time of both."""

    pairs: ClassVar[list[tuple[float, float]]] = []
    """Seconds of each whole step and of the bare step after it."""

    def on_fit_start(self) -> None:
        super().on_fit_start()
        twin = copy.deepcopy(self.scorer)
        self._twin = (
            twin,
            self.optimizer(twin.parameters()),
        )  # in a tuple it is no part of this module
        batch_size = self.trainer.datamodule.batch_size
        with torch.random.fork_rng(devices=[]):
            self._features = torch.randn(batch_size, self.hypotheses, self.problem.feature_size)

    def on_train_epoch_start(self) -> None:
        self._start: float | None = None

    def on_train_batch_end(self, *_: Any) -> None:
        end = time.perf_counter()
        scorer, optimizer = self._twin
        optimizer.zero_grad()
        scorer(self._features).mean().backward()
        optimizer.step()
        bare = time.perf_counter() - end
        if self._start is not None:  # an epoch's first step also starts the loader
            self.pairs.append((end - self._start, bare))
        self._start = time.perf_counter()


def run(views: int, epochs: int, progress_bar: bool, save_every: int) -> list[tuple[float, float]]:
    """Seconds of each whole and each bare step of a training on ``views`` views."""
    TimedEstimator.pairs.clear()
    with tempfile.TemporaryDirectory() as folder:
        frames = {"train": 4096, "validation": 16, "test": 16}
        config = configuration("train", f"progress_bar={progress_bar}", f"save_every={save_every}")
        config["data"] = scene.DATA | {"cache": folder, "views": views, "frames": frames}
        config["model"]["_target_"] = "__main__.TimedEstimator"
        config["trainer"] |= {"max_epochs": epochs, "accelerator": "cpu", "devices": 1}
        output = Path(folder) / "run"
        typed = typed_settings(TrainSettings, config | {"output": str(output)})
        train(typed, output)
    return list(TimedEstimator.pairs)


def main() -> None:
    wanted = settings(views="4,7", epochs=1, progress_bar=1, save_every=16)
    title, rows = machine(), []
    for views in map(int, wanted["views"].split(",")):
        pairs = run(views, wanted["epochs"], bool(wanted["progress_bar"]), wanted["save_every"])
        whole, bare = (
            [1000 * seconds for seconds in column] for column in zip(*pairs, strict=True)
        )
        ratios = sorted(a / b for a, b in pairs)
        rows.append(
            [
                str(views),
                str(len(pairs)),
                f"{statistics.median(whole):.0f}",
                f"{statistics.median(bare):.0f}",
                f"{statistics.median(ratios):.3f}",
                f"{ratios[len(ratios) // 4]:.3f} to {ratios[3 * len(ratios) // 4]:.3f}",
                f"{sum(whole) / sum(bare):.3f}",
            ]
        )
    show(
        title,
        ["views", "steps", "whole, ms", "bare, ms", "ratio", "quartiles", "of the means"],
        rows,
    )


if __name__ == "__main__":
    main()
