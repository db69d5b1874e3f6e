"""Batches of frames through a predictor into shards, on as many devices as Lightning has."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch.utils.data import DataLoader

from ghpt.commands.lost import told
from ghpt.commands.prediction.frames import Frames
from ghpt.commands.prediction.shards import Shards
from ghpt.commands.train import display_path, make_trainer
from ghpt.observations import Observations
from ghpt.reconstruction import Reconstruction

Predictor = Callable[[Observations], Reconstruction]
_log = logging.getLogger(__name__)


class ShardPrediction(L.LightningModule):
    """Predicts the shards that are missing; each process takes its share of them. ``weights``: what
    moves to the device with it.
    """

    def __init__(
        self,
        frames: Frames,
        predictor: Predictor,
        weights: torch.nn.Module | None,
        shards: Shards,
        batch: int,
        bar: bool,
    ) -> None:
        super().__init__()
        self.frames = frames
        self.predictor = predictor
        self.weights = weights
        self.shards = shards
        self.size = batch
        self.bar = bar
        self.pending = shards.missing()
        self.tick: Callable[[int], None] = lambda frames: None
        self.shown = ExitStack()
        """To be closed however the prediction ends: a bar left open hides the terminal's cursor."""

    def predict_dataloader(self) -> DataLoader[int]:
        mine = self.pending[self.trainer.global_rank :: self.trainer.world_size]
        return DataLoader(mine, batch_size=None)  # type: ignore[arg-type]

    @torch.no_grad()
    def predict_step(self, shard: int, batch_idx: int) -> int:
        rows = np.array(self.shards.rows(int(shard)))
        parts = []
        for start in range(0, len(rows), self.size):
            batch = self.frames.batch(rows[start : start + self.size]).to(self.device)
            parts.append(self.frames.to_world(to_cpu(self.predictor(batch))))
            self.tick(len(batch))
        self.shards.write(int(shard), joined(parts))
        return int(shard)

    def on_predict_start(self) -> None:
        mine = self.pending[self.trainer.global_rank :: self.trainer.world_size]
        frames = sum(len(self.shards.rows(shard)) for shard in mine)
        self.tick = self.shown.enter_context(_bar(frames, self.bar and self.trainer.is_global_zero))

    def on_predict_end(self) -> None:
        self.shown.close()


@contextmanager
def predicted(
    frames: Frames,
    predictor: Predictor,
    weights: torch.nn.Module | None,
    folder: Path,
    key: str,
    settings: dict[str, Any],
) -> Iterator[Shards | None]:
    """Predict what is missing of a recording's shards and yield them; None in the processes beside
    the first.
    """
    ours = {
        "logger": False,
        "enable_checkpointing": False,
        "enable_progress_bar": False,
        "default_root_dir": folder,
    }
    trainer = make_trainer(settings["trainer"], **ours)
    shards = Shards(
        folder, key, len(frames), settings["shard_frames"], clean=trainer.is_global_zero
    )
    module = ShardPrediction(
        frames, predictor, weights, shards, settings["batch"], settings["progress_bar"]
    )
    with closing(shards), _stop_told(shards, trainer.is_global_zero):
        if module.pending:
            with module.shown, told(trainer):
                trainer.predict(module, return_predictions=False)
                trainer.strategy.barrier()
            shards.look()
        yield shards if trainer.is_global_zero else None


@contextmanager
def _stop_told(shards: Shards, first: bool) -> Iterator[None]:
    """Say what there is to go on from, if the block ends early."""
    try:
        yield
    except BaseException:
        if first:
            shards.look()
            done = len(shards) - len(shards.missing())
            _log.warning(
                "Stopped. %d of %d shards are in %s.",
                done,
                len(shards),
                display_path(shards.folder),
            )
            _log.warning("The same command goes on with them.")
        raise


def to_cpu(part: Reconstruction) -> Reconstruction:
    return Reconstruction(**{f.name: getattr(part, f.name).cpu() for f in fields(Reconstruction)})


def joined(parts: list[Reconstruction]) -> Reconstruction:
    """Successive parts as one."""
    values = {
        f.name: torch.cat([getattr(part, f.name) for part in parts]) for f in fields(Reconstruction)
    }
    return Reconstruction(**values)


@contextmanager
def _bar(frames: int, visible: bool) -> Iterator[Callable[[int], None]]:
    """What is to be called with the number of frames done."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), disable=not visible) as bar:
        task = bar.add_task("Frames", total=frames)
        yield lambda done: bar.advance(task, done)
