"""The work of the commonest tasks: prepare a split, train, test."""

from pathlib import Path
from typing import Any

from ghpt.commands.test import measure
from ghpt.commands.train import train
from ghpt.config import build
from ghpt.files import write_json
from ghpt.models.checkpoint import LAST, PREVIOUS, AtomicCheckpointIO, read_checkpoint

QUIET = {"progress_bar": False}
CHECKPOINT = LAST


def prepare_split(config: dict[str, Any], dependencies: dict[str, Path], folder: Path) -> None:
    """Have the recordings of ``config["data"]``, split ``config["split"]``, in the cache of
    prepared recordings.
    """
    recordings = build(config["data"], "data").recordings(config["split"])
    write_json(folder / "result.json", {"frames": sum(map(len, recordings))})


def train_model(config: dict[str, Any], dependencies: dict[str, Path], folder: Path) -> None:
    """What train.py does; the checkpoint is kept without the optimiser, two thirds of it, for
    nobody goes on from here.

    result.json: the validation errors (mm).
    """
    errors = train(config | QUIET | {"save_every": 1_000_000, "resume": False}, folder)
    for name in ("best.ckpt", PREVIOUS):
        (folder / name).unlink(missing_ok=True)
    checkpoint = read_checkpoint(folder / CHECKPOINT)
    AtomicCheckpointIO().save_checkpoint(checkpoint | {"optimizer_states": []}, folder / CHECKPOINT)
    write_json(folder / "result.json", errors)


def test_model(config: dict[str, Any], dependencies: dict[str, Path], folder: Path) -> None:
    """What test.py computes with the model of ``dependencies["model"]``: metrics.json, predictions.npz."""
    measure(config | QUIET | {"ckpt": str(dependencies["model"] / CHECKPOINT)}, folder)


test_model.__test__ = False  # not one for pytest
