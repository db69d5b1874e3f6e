"""From test steps to predictions.npz: the callbacks that run the other estimators and write every
item's estimates.
"""

import shutil
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback

from ghpt.models.aggregation import AGGREGATIONS
from ghpt.models.pool import Pool
from ghpt.models.pose.predictions import PredictionWriter
from ghpt.models.relative_pose.predictions import PairWriter
from ghpt.observations import (
    Labelled,
    Observations,
    PairObservations,
    PairTruth,
    Truth,
)


class Collect(Callback):
    """Writes ``<folder>/predictions.npz``, streaming: memory does not grow with the number of
    items.

    ``estimators``: name -> what takes a batch; they get the same detections as the selections.
    """

    def __init__(
        self, folder: Path, estimators: Mapping[str, Callable[[Any], Any]], meta: dict[str, Any]
    ) -> None:
        self.path = folder / "predictions.npz"
        self.estimators = estimators
        self.meta = meta
        self.rows = folder / ".predictions"

    @abstractmethod
    def open(self, names: list[str]) -> None:
        """Make the writer, of ``self.data``."""

    @abstractmethod
    def write(self, module: Any, batch: Any, pool: Pool) -> None:
        """Write a batch with the aggregations' estimates."""

    @abstractmethod
    def finish(self) -> None:
        """Make the file ``self.path``."""

    def on_test_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self.data = trainer.datamodule.frames["test"]
        self.open([*AGGREGATIONS, *self.estimators])

    @torch.no_grad()
    def on_test_batch_end(
        self, trainer: L.Trainer, module: L.LightningModule, outputs: Any, batch: Any, *_: Any
    ) -> None:
        self.write(module, batch, outputs)

    def on_exception(
        self, trainer: L.Trainer, module: L.LightningModule, exception: BaseException
    ) -> None:
        if trainer.is_global_zero:  # nobody goes on with them
            shutil.rmtree(self.rows, ignore_errors=True)

    def on_test_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        trainer.strategy.barrier("all predictions are written")
        if trainer.is_global_zero:
            self.finish()
        trainer.strategy.barrier("predictions.npz is there")


class CollectPoses(Collect):
    """Of the pose problem."""

    def open(self, names: list[str]) -> None:
        self.writer = PredictionWriter(self.rows, len(self.data), names)

    def write(
        self,
        module: Any,
        batch: Labelled[Observations, Truth],
        pool: Pool,
    ) -> None:
        observations = batch.observations
        estimates = {name: pool.estimate(name) for name in AGGREGATIONS}
        estimates |= {name: estimator(observations) for name, estimator in self.estimators.items()}
        index = observations.index
        frame = torch.from_numpy(self.data.frame_numbers(index.tolist()))
        self.writer.write(
            index, estimates, batch.truth, observations.recording, frame, pool.weight_summary()
        )

    def finish(self) -> None:
        self.writer.finish(self.path, self.data.recordings, self.meta)


class CollectPairs(Collect):
    """Of the camera problem. The estimators' translations, of length 1, get their length where the
    learned ones do.
    """

    def open(self, names: list[str]) -> None:
        self.writer = PairWriter(self.rows, len(self.data), names)

    def write(
        self,
        module: Any,
        batch: Labelled[PairObservations, PairTruth],
        pool: Pool,
    ) -> None:
        estimates = {name: pool.estimate(name) for name in AGGREGATIONS}
        for name, estimator in self.estimators.items():
            estimate = estimator(batch.observations)
            length = module.problem.scale(estimate, batch.observations)
            estimates[name] = replace(estimate, t=estimate.t * length[..., None])
        of = batch.observations
        truth = batch.truth.relative_pose()
        self.writer.write(
            of.index, estimates, truth, of.rig, of.draw, of.pair, pool.weight_summary()
        )

    def finish(self) -> None:
        self.writer.finish(
            self.path, self.data.rigs, self.meta | {"frames": self.data.frames_per_item}
        )
