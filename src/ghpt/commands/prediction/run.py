"""Batches of frames through a predictor into shards, on as many devices as Lightning has."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch.utils.data import DataLoader

from ghpt.commands.display import display_path
from ghpt.commands.lost import report_end
from ghpt.commands.prediction.shards import Shards
from ghpt.commands.trainer import make_trainer
from ghpt.data.people.sequence import Sequence
from ghpt.models.estimators.predictors import Predictor

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RunSettings:
    """How a recording is worked through."""

    shard_frames: int
    """Frames of a shard: what an interruption costs at most."""
    batch: int
    """Frames that are predicted at a time."""
    progress_bar: bool
    trainer: Mapping[str, Any]


class ShardPrediction(L.LightningModule):
    """Predict the shards that are missing; each process takes its share of them.

    ``weights``: what moves to the device with it.
    """

    def __init__(
        self,
        sequence: Sequence,
        predictor: Predictor,
        weights: torch.nn.Module | None,
        shards: Shards,
        batch: int,
        progress_bar: bool,
    ) -> None:
        super().__init__()
        self.sequence = sequence
        self.predictor = predictor
        self.weights = weights
        self.shards = shards
        self.batch = batch
        self.progress_bar = progress_bar
        self.pending = shards.missing()
        self.advance: Callable[[int], None] = lambda frames: None
        self.bar = ExitStack()
        """To be closed however the prediction ends: a bar left open hides the terminal's cursor."""

    def predict_dataloader(self) -> DataLoader[int]:
        # A list is all that a DataLoader needs of a data set, but its type says Dataset.
        return DataLoader(self._own_shards(), batch_size=None)  # type: ignore[arg-type]

    @torch.no_grad()
    def predict_step(self, shard: int, batch_idx: int) -> int:
        rows = np.array(self.shards.rows(int(shard)))
        part = self.predictor.predict(self.sequence, rows, self.batch, self.device, self.advance)
        self.shards.write(int(shard), self.sequence.to_world(part))
        return int(shard)

    def on_predict_start(self) -> None:
        frames = sum(len(self.shards.rows(shard)) for shard in self._own_shards())
        visible = self.progress_bar and self.trainer.is_global_zero
        self.advance = self.bar.enter_context(_progress(frames, visible))

    def on_predict_end(self) -> None:
        self.bar.close()

    def _own_shards(self) -> list[int]:
        return self.pending[self.trainer.global_rank :: self.trainer.world_size]


@contextmanager
def predict_shards(
    sequence: Sequence,
    predictor: Predictor,
    weights: torch.nn.Module | None,
    folder: Path,
    key: str,
    settings: RunSettings,
) -> Iterator[Shards | None]:
    """Predict what is missing of a recording's shards and yield them.

    Yields None in the processes beside the first.
    """
    trainer = make_trainer(
        dict(settings.trainer),
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        default_root_dir=folder,
    )
    first = trainer.is_global_zero
    shards = Shards(folder, key, len(sequence), settings.shard_frames, clean=first)
    module = ShardPrediction(
        sequence, predictor, weights, shards, settings.batch, settings.progress_bar
    )
    with closing(shards), _report_stop(shards, first):
        if module.pending:
            with module.bar, report_end(trainer):
                trainer.predict(module, return_predictions=False)
                trainer.strategy.barrier()
            shards.refresh()
        yield shards if first else None


@contextmanager
def _report_stop(shards: Shards, first: bool) -> Iterator[None]:
    """Say what there is to go on from, if the block ends early."""
    try:
        yield
    except BaseException:
        if first:
            shards.refresh()
            total = len(shards)
            done = total - len(shards.missing())
            folder = display_path(shards.folder)
            _log.warning("Stopped. %d of %d shards are in %s.", done, total, folder)
            _log.warning("The same command goes on with them.")
        raise


@contextmanager
def _progress(frames: int, visible: bool) -> Iterator[Callable[[int], None]]:
    """Show a bar; yields the function to call with the number of frames done."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), disable=not visible) as bar:
        task = bar.add_task("Frames", total=frames)
        yield lambda done: bar.advance(task, done)
