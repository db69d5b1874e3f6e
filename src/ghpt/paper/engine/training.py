"""The action that trains a model."""

from pathlib import Path
from typing import Any

from ghpt.commands.train import TrainSettings, train
from ghpt.config import settings
from ghpt.files import write_json
from ghpt.models.checkpoint import LAST, PREVIOUS, AtomicCheckpointIO, read_checkpoint

_NEVER = 1_000_000
"""A number of steps between two checkpoints that no training has."""


def train_model(config: dict[str, Any], dependencies: dict[str, Path], folder: Path) -> None:
    """Train as train.py does, and keep the last checkpoint.

    The checkpoint is kept without the state of the optimiser, which is two thirds of it, for no
    training is resumed from it. result.json holds the validation errors (mm).
    """
    own = {
        "save_every": _NEVER,
        "resume": False,
        "progress_bar": False,
        "output": str(folder),
    }
    values = {key: value for key, value in config.items() if key != "files"}
    errors = train(settings(TrainSettings, values | own), folder)
    for name in ("best.ckpt", PREVIOUS):
        (folder / name).unlink(missing_ok=True)
    checkpoint = read_checkpoint(folder / LAST)
    AtomicCheckpointIO().save_checkpoint(checkpoint | {"optimizer_states": []}, folder / LAST)
    write_json(folder / "result.json", errors)
