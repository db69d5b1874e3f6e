"""From test steps to predictions.npz: the callback that runs the baselines and writes every frame's poses."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback

from ghpt.models.selection import SELECTIONS
from ghpt.recording import KeyPointBatch, PoseEstimate
from ghpt.report.predictions import PredictionWriter


class CollectPredictions(Callback):
    """Writes ``<folder>/predictions.npz``, streaming: memory does not grow with the number of frames.

    ``baselines``: name -> estimator that takes a batch; they get the same detections as the selections.
    """

    def __init__(
        self, folder: Path, baselines: Mapping[str, Callable[[KeyPointBatch], PoseEstimate]], meta: dict[str, Any]
    ) -> None:
        self.path, self.baselines, self.meta = folder / "predictions.npz", baselines, meta
        self.rows = folder / ".predictions"

    def on_test_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self.frames = trainer.datamodule.frames["test"]
        self.writer = PredictionWriter(self.rows, len(self.frames), [*SELECTIONS, *self.baselines])

    @torch.no_grad()
    def on_test_batch_end(
        self, trainer: L.Trainer, module: L.LightningModule, outputs: Any, batch: KeyPointBatch, *_: Any
    ) -> None:
        estimates, weights = outputs
        estimates = estimates | {name: estimator(batch) for name, estimator in self.baselines.items()}
        frame = torch.from_numpy(self.frames.frame_numbers(batch.sample.tolist()))
        self.writer.write(batch.sample, estimates, batch.truth, batch.truth_seen, batch.recording, frame, weights)

    def on_test_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        trainer.strategy.barrier("all predictions are written")
        if trainer.is_global_zero:
            self.writer.finish(self.path, self.frames.recordings, self.meta)
        trainer.strategy.barrier("predictions.npz is there")
