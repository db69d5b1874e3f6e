"""Training: from a configuration to a checkpoint that test.py can use on any cameras."""

from pathlib import Path
from typing import Any

import lightning as L
import torch

from ghpt.config import build
from ghpt.errors import GhptCheckpointError
from ghpt.files import sweep_temporaries
from ghpt.models.callbacks import SaveLast, best_checkpoint
from ghpt.models.checkpoint import FIELD, FORMAT_VERSION, AtomicCheckpointIO, read_checkpoint
from ghpt.provenance import provenance
from ghpt.report.logger import ForgivingTensorBoard


def train(config: dict[str, Any], output: Path) -> dict[str, float]:
    """Train ``config["model"]`` on ``config["data"]``; returns the validation errors (mm).

    Writes ``last.ckpt``, ``best.ckpt`` and TensorBoard events into ``output``. With ``resume`` it goes on from
    ``last.ckpt`` there, to the same numbers as an uninterrupted run.
    """
    torch.set_float32_matmul_precision("high")
    seed = config["seed"]
    data = build(config["data"], "data")
    model = build(config["model"], "model")
    identity = {
        "format_version": FORMAT_VERSION,
        "config": {"model": config["model"], "data": config["data"], "seed": seed},
        "provenance": provenance(seed) | {"data": data.name, "source": data.source},
    }
    sweep_temporaries(output)
    last = output / "last.ckpt"
    if config["resume"]:
        _check_resumable(last, config)
    trainer = L.Trainer(
        **build(config["trainer"], "trainer"),
        default_root_dir=output,
        logger=ForgivingTensorBoard(output),
        plugins=[AtomicCheckpointIO()],
        callbacks=[
            SaveLast(last, config["save_every"], identity),
            best_checkpoint(output),
            *progress(config),
        ],
        enable_progress_bar=config["progress_bar"],
        use_distributed_sampler=False,
        num_sanity_val_steps=0,
    )
    trainer.fit(model, datamodule=data, ckpt_path=str(last) if config["resume"] else None, weights_only=True)
    return {k: float(v) for k, v in trainer.callback_metrics.items() if k.startswith("validation/")}


def progress(config: dict[str, Any]) -> list[L.Callback]:
    return [L.pytorch.callbacks.RichProgressBar()] if config["progress_bar"] else []


def _check_resumable(last: Path, config: dict[str, Any]) -> None:
    saved = read_checkpoint(last)[FIELD]["config"]
    for part in ("model", "data", "seed"):
        if saved[part] != config[part]:
            raise GhptCheckpointError(last, f"was made with other settings of {part!r}", "Resume with the same ones.")
