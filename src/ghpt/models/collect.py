"""The callback that writes predictions.npz while a model is tested."""

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback

from ghpt.models.pool import Pool
from ghpt.models.predictions import PredictionWriter
from ghpt.models.problem import Problem
from ghpt.observations import Labelled


@runtime_checkable
class OfRecordings(Protocol):
    """A baseline that sees whole recordings and not the batches alone."""

    def open(self, dataset: Any) -> None:
        """Take the data set that is tested."""


class CollectPredictions(Callback):
    """Writes ``<folder>/predictions.npz``, streaming: memory does not grow with the samples.

    ``baselines``: what takes observations, by name; they get the same ones as the aggregations.
    ``meta``: what the file says of itself, as plain data.
    """

    def __init__(
        self,
        folder: Path,
        problem: Problem,
        baselines: Mapping[str, Callable[[Any], Any]],
        meta: Mapping[str, Any],
    ) -> None:
        self.path = folder / "predictions.npz"
        self.problem = problem
        self.baselines = baselines
        self.meta = dict(meta) | problem.meta()
        self._folder = folder / ".predictions"

    def open(self, dataset: Any) -> None:
        """Make room for the samples of a data set."""
        for baseline in self.baselines.values():
            if isinstance(baseline, OfRecordings):
                baseline.open(dataset)
        names = [*self.problem.aggregations, *self.baselines]
        self._dataset = dataset
        self._writer = PredictionWriter(self._folder, len(dataset), names, self.problem.schema)

    def write(self, batch: Labelled[Any, Any], pool: Pool) -> None:
        """Write what the aggregations of a pool and the baselines make of a batch."""
        observations = batch.observations
        estimates = {name: pool.estimate(name) for name in self.problem.aggregations}
        for name, baseline in self.baselines.items():
            estimate = baseline(observations)
            estimates[name] = self.problem.from_baseline(estimate, observations)
        sample = self.problem.record(batch, self._dataset)
        self._writer.write(observations.index, estimates, sample, pool.weight_summary())

    def finish(self) -> None:
        """Make the file."""
        self._writer.finish(self.path, self.problem.tables(self._dataset), self.meta)

    def on_test_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        data = trainer.datamodule  # type: ignore[attr-defined]  # Lightning does not declare it
        self.open(data.frames["test"])

    @torch.no_grad()
    def on_test_batch_end(
        self, trainer: L.Trainer, module: L.LightningModule, outputs: Any, batch: Any, *_: Any
    ) -> None:
        self.write(batch, outputs)

    def on_exception(
        self, trainer: L.Trainer, module: L.LightningModule, exception: BaseException
    ) -> None:
        if trainer.is_global_zero:  # nobody goes on with what is half written
            shutil.rmtree(self._folder, ignore_errors=True)

    def on_test_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        trainer.strategy.barrier("all predictions are written")
        if trainer.is_global_zero:
            self.finish()
        trainer.strategy.barrier("predictions.npz is there")
