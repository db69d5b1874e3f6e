"""Training: from a configuration to a checkpoint that test.py can use on any cameras."""

import logging
import os
import re
from pathlib import Path
from typing import Any, Literal, TypedDict

import lightning as L
import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException

from ghpt.commands.app import Command
from ghpt.commands.catalogue import run_by_name
from ghpt.commands.lost import OwnSignals, told
from ghpt.commands.outputs import Files, input_paths
from ghpt.config import build, check_arguments, check_plain, check_type
from ghpt.errors import GhptCheckpointError, GhptConfigError
from ghpt.files import adopt, set_aside, sweep_temporaries
from ghpt.models.callbacks import LogHyperparameters, Progress, SaveLast, best_checkpoint
from ghpt.models.checkpoint import (
    FIELD,
    FORMAT_VERSION,
    LAST,
    PREVIOUS,
    AtomicCheckpointIO,
    check_fit,
    read_checkpoint,
)
from ghpt.models.registry import check_registered, packages_to_trust
from ghpt.provenance import provenance
from ghpt.report.logger import ForgivingTensorBoard
from ghpt.report.tables import display_name

_STATE = {
    "epoch": int,
    "global_step": int,
    "loops": dict,
    "callbacks": dict,
    "optimizer_states": list,
    "lr_schedulers": list,
    "pytorch-lightning_version": str,
}
"""What Lightning needs of a checkpoint to go on from it."""
BEST = "best.ckpt"
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
    if config["resume"]:  # the checkpoints prove by their own digests that ghpt wrote them
        return Files(reads=input_paths(config), writes=(BEST,))
    checkpoints = (LAST, PREVIOUS, BEST)
    return Files(reads=input_paths(config), writes=checkpoints, keeps=checkpoints)


def train(config: dict[str, Any], output: Path) -> dict[str, float]:
    """Train ``config["model"]`` on ``config["data"]``; returns the validation errors (mm).

    Writes ``last.ckpt``, ``previous.ckpt``, ``best.ckpt`` and TensorBoard events into ``output``.
    With ``resume`` it goes on from ``last.ckpt`` there, or from ``previous.ckpt`` if that is
    damaged, to the same numbers as an uninterrupted run; ``auto`` does so where there is one. Exits
    with 130 on SIGINT, and with 143 on SIGTERM and SIGHUP.
    """
    check_type(config, Settings, "")
    torch.set_float32_matmul_precision("high")
    seed = config["seed"]
    data = build(config["data"], "data")
    model = build(config["model"], "model")
    _check_optimizer(model)
    _warn_of_classes(config["model"])
    data.bind(model.problem)
    identity = {
        "format_version": FORMAT_VERSION,
        "config": {"model": config["model"], "data": config["data"], "seed": seed},
        "provenance": provenance(seed) | {"data": data.name, "source": data.source},
    }
    check_plain(identity, "config")
    last = output / LAST
    resume = config["resume"]
    if resume == "auto":
        resume = last.exists() or (output / PREVIOUS).exists()
    start, warning = resumable(output, config, model) if resume else (None, "")
    saver = SaveLast(last, config["save_every"], identity, resumed=start == last)
    about = {
        "data": data.name,
        "source": data.source,
        "train_samples": data.train_samples,
        "seed": seed,
    }
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
    if trainer.is_global_zero and start is not None:
        adopt(start)
        if start != last:
            set_aside(last)
    if warning and trainer.is_global_zero:
        _log.warning(warning)
    try:
        with told(trainer):
            trainer.fit(model, datamodule=data, ckpt_path=start and str(start), weights_only=True)
    except (SystemExit, Exception) as stop:
        if trainer.is_global_zero and (saver.saved is not None or isinstance(stop, SystemExit)):
            _say_stopped(last, saver.saved)
        raise
    errors = {
        k: float(v) for k, v in trainer.callback_metrics.items() if k.startswith("validation/")
    }
    if trainer.is_global_zero:
        _say_finished(last, data, config["model"], model.problem.measures, errors)
    return errors


def summary(errors: dict[str, float]) -> str:
    """What `train` returned, in words."""
    numbers = (
        f"{name.removeprefix('validation/')} {error:.1f} mm" for name, error in errors.items()
    )
    return ", ".join(numbers) or "nothing was left to do"


def make_trainer(settings: dict[str, Any], **ours: Any) -> L.Trainer:
    """Lightning's Trainer of the yaml's settings and ``ours``. Raises GhptConfigError for what it
    does not take.
    """
    settings = build(settings, "trainer")
    ours["callbacks"] = [*ours.get("callbacks", ()), OwnSignals()]
    for key in set(settings) & set(ours):
        raise GhptConfigError(
            f"trainer.{key}", "is not for the configuration: ghpt sets it", "Leave it out."
        )
    check_arguments(L.Trainer, settings, "trainer")
    try:
        return L.Trainer(**settings, **ours, use_distributed_sampler=False)
    except (TypeError, ValueError, MisconfigurationException) as error:
        raise GhptConfigError(
            "trainer", str(error).rstrip("."), "See lightning.Trainer's arguments."
        ) from error


def progress(config: dict[str, Any]) -> list[L.Callback]:
    return [Progress()] if config["progress_bar"] else []


def display_path(path: Path) -> str:
    """A path as short as it can be typed here."""
    relative = os.path.relpath(path)
    return str(path) if relative.startswith("..") else relative


def shell_override(key: str, value: object) -> str:
    """``key=value`` as a shell and Hydra's grammar take it."""
    text = f"{key}={value}"
    return text if re.fullmatch(r"[\w=./+-]+", text) else f"\"{key}='{value}'\""


def _check_optimizer(model: Any) -> None:
    """The optimiser's own checks, before the data are prepared."""
    try:
        model.configure_optimizers()
    except (TypeError, ValueError) as error:
        raise GhptConfigError("model.optimizer", str(error), "Change this setting.") from error


def _warn_of_classes(model: dict[str, Any]) -> None:
    """Say before the training, not after it, that its checkpoint will not be taken."""
    try:
        check_registered(model)
    except GhptConfigError as error:
        _log.warning("test.py and predict.py will not take this model: %s", error)


def resumable(output: Path, config: dict[str, Any], model: Any) -> tuple[Path, str]:
    """The checkpoint in ``output`` to go on from, and a warning if it is not the last.

    Raises GhptCheckpointError if neither the last nor the previous one can be used, and if the one
    that can was made with other settings.
    """
    last = output / LAST
    previous = output / PREVIOUS
    try:
        _check_resumable(last, config, model)
        return last, ""
    except OtherSettings:
        raise
    except GhptCheckpointError as error:
        if not previous.exists():
            raise
        reason = f"{display_path(last)}: {error.problem}"
    try:
        step = _check_resumable(previous, config, model)
    except OtherSettings:
        raise
    except GhptCheckpointError as error:
        problem = f"{reason}; {previous.name}: {error.problem}"
        hint = "There is nothing to go on from: train without resume=true, in another output."
        raise GhptCheckpointError(output, problem, hint) from None
    return previous, f"{reason}. Going on from {previous.name}, which holds training step {step}."


class OtherSettings(GhptCheckpointError):
    """A checkpoint that is whole, and of another training."""


def _check_resumable(path: Path, config: dict[str, Any], model: Any) -> int:
    """A checkpoint's training step. Raises GhptCheckpointError if it cannot be gone on from."""
    checkpoint = read_checkpoint(path)
    saved = checkpoint[FIELD].get("config")
    hint = "Give one that train.py wrote."
    if not isinstance(saved, dict):
        raise GhptCheckpointError(path, "does not say what it is of", hint)
    for part in ("model", "data", "seed"):
        if part not in saved or _what(saved[part]) != _what(config[part]):
            problem = f"was made with other settings of {part!r}"
            raise OtherSettings(path, problem, "Resume with the same ones.")
    for name, kind in _STATE.items():
        state = checkpoint.get(name)
        if type(state) is not kind or (name == "optimizer_states" and not state):
            raise GhptCheckpointError(path, f"holds no state of a training ({name})", hint)
    try:
        check_fit(model, checkpoint["state_dict"])
    except ValueError as error:
        raise GhptCheckpointError(path, f"does not fit its own model ({error})", hint) from None
    return checkpoint["global_step"]


def _what(settings: Any) -> Any:
    """What decides the numbers: not how the batches are loaded, which one may have to change to go
    on.
    """
    return (
        {k: v for k, v in settings.items() if k != "workers"}
        if isinstance(settings, dict)
        else settings
    )


def _flat(config: Any, above: str) -> dict[str, Any]:
    """``{"a.b": value}``, lists as text: what TensorBoard takes as hyper-parameters."""
    if not isinstance(config, dict):
        return {above: config if isinstance(config, bool | int | float | str) else str(config)}
    return {
        k: v
        for name, value in config.items()
        if name[0] != "_"
        for k, v in _flat(value, f"{above}.{name}").items()
    }


def _say_finished(
    last: Path,
    data: Any,
    model: dict[str, Any],
    measures: str,
    errors: dict[str, float],
) -> None:
    _log.info("Validation on %s, %s:", display_name(data.name, data.source), measures)
    _log.info("  %s", summary(errors))
    _log.info("Checkpoint: %s", display_path(last))
    where = (
        "data=h36m"
        if data.root is None
        else f"data={data.name} {shell_override('data.root', data.root)}"
    )
    trust = ",".join(packages_to_trust(model))
    command = ["python test.py", shell_override("ckpt", display_path(last)), where]
    if trust:
        command.append(f"'trust=[{trust}]'")
    _log.info("Test it: %s", " ".join(command))


def _say_stopped(last: Path, step: int | None) -> None:
    if step is None:
        _log.warning("Stopped before the first checkpoint of this run.")
    else:
        _log.warning("Stopped. %s holds training step %d.", display_path(last), step)
        _log.warning(
            "Go on with the same command and %s resume=true",
            shell_override("output", display_path(last.parent)),
        )


COMMAND = Command(name="train", settings=dict, task=train, summary=summary, files=files)


if __name__ == "__main__":
    run_by_name("train")
