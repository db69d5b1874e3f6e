"""Training: from a configuration to a checkpoint that test.py can use on any cameras."""

import logging
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, TypedDict

import lightning as L
import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.utilities.exceptions import SIGTERMException

from ghpt.app import Command
from ghpt.config import build, check_arguments, check_type
from ghpt.errors import GhptCheckpointError, GhptConfigError
from ghpt.files import sweep_temporaries
from ghpt.models.callbacks import LogHyperparameters, Progress, SaveLast, best_checkpoint
from ghpt.models.checkpoint import FIELD, FORMAT_VERSION, AtomicCheckpointIO, read_checkpoint
from ghpt.outputs import Files, input_paths
from ghpt.provenance import provenance
from ghpt.report.logger import ForgivingTensorBoard
from ghpt.report.tables import words

LAST, BEST = "last.ckpt", "best.ckpt"
_log = logging.getLogger(__name__)


class Settings(TypedDict):
    """What `train` needs of the configuration."""

    data: dict[str, Any]
    model: dict[str, Any]
    trainer: dict[str, Any]
    seed: int
    save_every: int
    resume: bool | Literal["auto"]
    progress_bar: bool


def files(config: dict[str, Any]) -> Files:
    """What a training reads and writes. Raises GhptConfigError for settings that cannot work."""
    check_type(config, Settings, "")
    checkpoints = (LAST, BEST)
    return Files(
        reads=input_paths(config),
        writes=checkpoints,
        keeps=() if config["resume"] else checkpoints,
    )


def train(config: dict[str, Any], output: Path) -> dict[str, float]:
    """Train ``config["model"]`` on ``config["data"]``; returns the validation errors (mm).

    Writes ``last.ckpt``, ``best.ckpt`` and TensorBoard events into ``output``. With ``resume`` it goes on from
    ``last.ckpt`` there, to the same numbers as an uninterrupted run; ``auto`` does so where there is one. Exits with
    130 on SIGINT and 143 on SIGTERM.
    """
    check_type(config, Settings, "")
    torch.set_float32_matmul_precision("high")
    seed = config["seed"]
    data = build(config["data"], "data")
    model = build(config["model"], "model")
    _check_optimizer(model)
    data.serve(model.problem)
    identity = {
        "format_version": FORMAT_VERSION,
        "config": {"model": config["model"], "data": config["data"], "seed": seed},
        "provenance": provenance(seed) | {"data": data.name, "source": data.source},
    }
    last = output / LAST
    resume = last.exists() if config["resume"] == "auto" else config["resume"]
    saver = SaveLast(last, config["save_every"], identity)
    about = {"data": data.name, "source": data.source, "train_samples": data.train_samples, "seed": seed}
    trainer = make_trainer(
        config["trainer"],
        default_root_dir=output,
        logger=ForgivingTensorBoard(output),
        plugins=[AtomicCheckpointIO()],
        callbacks=[
            saver,
            best_checkpoint(output),
            LogHyperparameters(about | _flat(config["model"], "model")),
            *progress(config),
        ],
        enable_progress_bar=config["progress_bar"],
        num_sanity_val_steps=0,
    )
    sweep_temporaries(output)
    if resume:
        _check_resumable(last, config)
    try:
        with shell_status():
            trainer.fit(model, datamodule=data, ckpt_path=str(last) if resume else None, weights_only=True)
    except SystemExit:
        if trainer.is_global_zero:
            _say_stopped(last, saver.saved)
        raise
    errors = {k: float(v) for k, v in trainer.callback_metrics.items() if k.startswith("validation/")}
    if trainer.is_global_zero:
        _say_finished(last, data, model.problem.measures, errors)
    return errors


def summary(errors: dict[str, float]) -> str:
    """What `train` returned, in words."""
    numbers = (f"{name.removeprefix('validation/')} {error:.1f} mm" for name, error in errors.items())
    return ", ".join(numbers) or "nothing was left to do"


def make_trainer(settings: dict[str, Any], **ours: Any) -> L.Trainer:
    """Lightning's Trainer of the yaml's settings and ``ours``. Raises GhptConfigError for what it does not take."""
    settings = build(settings, "trainer")
    for key in set(settings) & set(ours):
        raise GhptConfigError(f"trainer.{key}", "is not for the configuration: ghpt sets it", "Leave it out.")
    check_arguments(L.Trainer, settings, "trainer")
    try:
        return L.Trainer(**settings, **ours, use_distributed_sampler=False)
    except (TypeError, ValueError, MisconfigurationException) as error:
        raise GhptConfigError("trainer", str(error).rstrip("."), "See lightning.Trainer's arguments.") from error


def progress(config: dict[str, Any]) -> list[L.Callback]:
    return [Progress()] if config["progress_bar"] else []


@contextmanager
def shell_status() -> Iterator[None]:
    """An interrupt exits with 130 and SIGTERM with 143, as shells expect (Lightning's statuses are 1 and 0)."""
    try:
        yield
    except SIGTERMException as stop:
        raise SystemExit(143) from stop
    except SystemExit as stop:
        if isinstance(stop.__context__, KeyboardInterrupt):
            raise SystemExit(130) from stop
        raise


def shown(path: Path) -> str:
    """A path as short as it can be typed here."""
    relative = os.path.relpath(path)
    return str(path) if relative.startswith("..") else relative


def typed(key: str, value: object) -> str:
    """``key=value`` as a shell and Hydra's grammar take it."""
    text = f"{key}={value}"
    return text if re.fullmatch(r"[\w=./+-]+", text) else f"\"{key}='{value}'\""


def _check_optimizer(model: Any) -> None:
    """The optimiser's own checks, before the data are prepared."""
    try:
        model.configure_optimizers()
    except (TypeError, ValueError) as error:
        raise GhptConfigError("model.optimizer", str(error), "Change this setting.") from error


def _check_resumable(last: Path, config: dict[str, Any]) -> None:
    saved = read_checkpoint(last)[FIELD]["config"]
    for part in ("model", "data", "seed"):
        if saved[part] != config[part]:
            raise GhptCheckpointError(last, f"was made with other settings of {part!r}", "Resume with the same ones.")


def _flat(config: Any, above: str) -> dict[str, Any]:
    """``{"a.b": value}``, lists as text: what TensorBoard takes as hyper-parameters."""
    if not isinstance(config, dict):
        return {above: config if isinstance(config, bool | int | float | str) else str(config)}
    return {
        k: v for name, value in config.items() if name[0] != "_" for k, v in _flat(value, f"{above}.{name}").items()
    }


def _say_finished(last: Path, data: Any, measures: str, errors: dict[str, float]) -> None:
    _log.info("Validation on %s, %s:", words(data.name, data.source), measures)
    _log.info("  %s", summary(errors))
    _log.info("Checkpoint: %s", shown(last))
    where = "data=h36m" if data.root is None else f"data={data.name} {typed('data.root', data.root)}"
    _log.info("Test it: python test.py %s %s", typed("ckpt", shown(last)), where)


def _say_stopped(last: Path, step: int | None) -> None:
    if step is None:
        _log.warning("Stopped before the first checkpoint of this run.")
    else:
        _log.warning("Stopped. %s holds training step %d.", shown(last), step)
        _log.warning("Go on with the same command and %s resume=true", typed("output", shown(last.parent)))


COMMAND = Command("train", train, summary, files)
