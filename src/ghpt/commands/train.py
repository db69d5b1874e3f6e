"""Training: from settings to a checkpoint that test.py can use on any cameras."""

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch

from ghpt.commands.app import Command
from ghpt.commands.catalogue import run_by_name
from ghpt.commands.display import as_started, display_path, shell_override
from ghpt.commands.lost import report_end
from ghpt.commands.outputs import Files, OutputSettings, input_paths
from ghpt.commands.resume import Start, resumable
from ghpt.commands.trainer import in_our_words, make_loggers, make_trainer, progress
from ghpt.config import Target, build, check_plain, suggest
from ghpt.errors import GhptConfigError, check
from ghpt.files import adopt, set_aside, sweep_temporaries
from ghpt.models.callbacks import Best, LogHyperparameters, SaveLast, best_checkpoint
from ghpt.models.checkpoint import FORMAT_VERSION, LAST, PREVIOUS, AtomicCheckpointIO
from ghpt.models.loss import LossTerms
from ghpt.models.module import StochasticEstimator
from ghpt.models.registry import check_registered, packages_to_trust
from ghpt.provenance import provenance
from ghpt.report.hyperparameters import flatten
from ghpt.report.tables import display_name

BEST = "best.ckpt"
_VALIDATION = "validation/"
_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class TrainSettings(OutputSettings):
    """The settings of `train`."""

    data: Target
    model: Target
    trainer: Target
    seed: int
    save_every: int
    """Optimiser steps between writes of ``last.ckpt``."""
    resume: bool | Literal["auto"]
    """Whether to go on from a checkpoint in the output; ``auto``: where there is one."""
    progress_bar: bool
    logger: Target = field(default_factory=dict)
    """What shows the curves, by name; each is given the output folder."""
    callbacks: Target = field(default_factory=dict)
    """Lightning's callbacks, by name."""
    best: Best = field(default_factory=Best)
    """Which epoch ``best.ckpt`` is of, and whose metric a search lessens."""
    compile: bool = False
    """Whether the scorer is compiled (torch.compile)."""

    def decisive(self) -> dict[str, Any]:
        """Return the settings that a checkpoint is of, as plain data."""
        return {"model": self.model, "data": self.data, "seed": self.seed}


def files(settings: TrainSettings) -> Files:
    """Return what a training reads and writes."""
    reads = input_paths(settings.data.get("root"))
    if settings.resume:  # the checkpoints prove by their own digests that ghpt wrote them
        return Files(reads=reads, writes=(BEST,))
    checkpoints = (LAST, PREVIOUS, BEST)
    return Files(reads=reads, writes=checkpoints, keeps=checkpoints)


def train(settings: TrainSettings, output: Path) -> dict[str, float]:
    """Train a model, and return its validation errors (mm) by name.

    Writes ``last.ckpt``, ``previous.ckpt``, ``best.ckpt`` and TensorBoard events into ``output``.
    With ``resume`` it goes on from ``last.ckpt`` there, or from ``previous.ckpt`` if that is
    damaged, to the same numbers as an uninterrupted run. Exits with 130 on SIGINT, and with 143 on
    SIGTERM and SIGHUP.
    """
    torch.set_float32_matmul_precision("high")
    data = build(settings.data, "data")
    model = build(settings.model, "model")
    _check_optimizer(model)
    _warn_of_classes(settings.model)
    callbacks = build(settings.callbacks, "callbacks")
    _check_monitored(settings.best, callbacks, model)
    if settings.compile:
        model.scorer.compile()
    data.bind(model.problem)
    identity = _identity(settings, data)
    last = output / LAST
    start = _start(settings, output, model)
    saver = SaveLast(last, settings.save_every, identity, resumed=start.checkpoint == last)
    trainer = make_trainer(
        settings.trainer,
        default_root_dir=output,
        logger=make_loggers(settings.logger, output),
        plugins=[AtomicCheckpointIO()],
        callbacks=[
            saver,
            best_checkpoint(output, settings.best),
            LogHyperparameters(_hyperparameters(settings, data)),
            *callbacks.values(),
            *progress(settings.progress_bar),
        ],
        enable_progress_bar=settings.progress_bar,
        num_sanity_val_steps=0,
    )
    sweep_temporaries(output)
    if trainer.is_global_zero:
        _begin(start, last)
    ckpt_path = start.checkpoint and str(start.checkpoint)
    try:
        with report_end(trainer), in_our_words():
            trainer.fit(model, datamodule=data, ckpt_path=ckpt_path, weights_only=True)
    except (SystemExit, Exception) as stop:
        if trainer.is_global_zero and (saver.saved is not None or isinstance(stop, SystemExit)):
            _say_stopped(last, saver.saved)
        raise
    measured = trainer.callback_metrics.items()
    errors = {name: float(value) for name, value in measured if name.startswith(_VALIDATION)}
    if trainer.is_global_zero:
        _say_finished(last, data, settings.model, model.problem.measures, errors)
    return errors


def summary(errors: Mapping[str, float]) -> str:
    """Return the validation errors in one line."""
    numbers = [f"{name.removeprefix(_VALIDATION)} {mm:.1f} mm" for name, mm in errors.items()]
    return ", ".join(numbers) or "nothing was left to do"


def _identity(settings: TrainSettings, data: Any) -> dict[str, Any]:
    """Return what the checkpoints say of themselves. Raises GhptConfigError if it is not plain."""
    origin = provenance(settings.seed) | {"data": data.name, "source": data.source}
    identity = {
        "format_version": FORMAT_VERSION,
        "config": settings.decisive(),
        "provenance": origin,
    }
    check_plain(identity, "config")
    return identity


def _hyperparameters(settings: TrainSettings, data: Any) -> dict[str, Any]:
    """Return what TensorBoard shows beside the final errors."""
    about = {
        "data": data.name,
        "source": data.source,
        "train_samples": data.train_samples,
        "seed": settings.seed,
    }
    return about | dict(flatten(settings.model, "model"))


def _start(settings: TrainSettings, output: Path, model: StochasticEstimator) -> Start:
    """Return where the training begins. Raises GhptCheckpointError, see ``resumable``."""
    resume = settings.resume
    if resume == "auto":
        resume = (output / LAST).exists() or (output / PREVIOUS).exists()
    return resumable(output, settings.decisive(), model) if resume else Start()


def _begin(start: Start, last: Path) -> None:
    """Make the checkpoint that is gone on from this run's own, and put a damaged one aside."""
    if start.checkpoint is not None:
        adopt(start.checkpoint)
        if start.checkpoint != last:
            set_aside(last)
    if start.warning:
        _log.warning(start.warning)


def _check_optimizer(model: StochasticEstimator) -> None:
    """Let the optimiser check its settings before the data are prepared."""
    try:
        model.configure_optimizers()
    except (TypeError, ValueError) as error:
        raise GhptConfigError("model.optimizer", str(error), "Change this setting.") from error


def _check_monitored(best: Best, callbacks: Mapping[str, Any], model: StochasticEstimator) -> None:
    """Raise GhptConfigError, before the training, for a metric that it will not log."""
    logged = [f"{_VALIDATION}{name}" for name in model.validation]
    logged += [f"train/{name}" for name in LossTerms._fields]
    monitored = {"best": best.monitor}
    for name, callback in callbacks.items():
        monitor = getattr(callback, "monitor", None)
        if isinstance(monitor, str):
            monitored[f"callbacks.{name}"] = monitor
    for path, metric in monitored.items():
        hint = suggest(metric, logged)
        check(metric in logged, f"{path}.monitor", f"there is no metric {metric!r}", hint)


def _warn_of_classes(model: Target) -> None:
    """Say before the training, not after it, that its checkpoint will not be taken."""
    try:
        check_registered(model)
    except GhptConfigError as error:
        _log.warning("test.py and predict.py will not take this model: %s", error)


def _say_finished(
    last: Path, data: Any, model: Target, measures: str, errors: Mapping[str, float]
) -> None:
    _log.info("Validation on %s, %s:", display_name(data.name, data.source), measures)
    _log.info("  %s", summary(errors))
    _log.info("Checkpoint: %s", display_path(last))
    words = [as_started("python test.py"), shell_override("ckpt", display_path(last))]
    if data.root is None:
        words.append("data=h36m")
    else:
        words += [f"data={data.name}", shell_override("data.root", data.root)]
    trust = ",".join(packages_to_trust(model))
    if trust:
        words.append(f"'trust=[{trust}]'")
    _log.info("Test it: %s", " ".join(words))


def _say_stopped(last: Path, step: int | None) -> None:
    if step is None:
        _log.warning("Stopped before the first checkpoint of this run.")
        return
    _log.warning("Stopped. %s holds training step %d.", display_path(last), step)
    output = shell_override("output", display_path(last.parent))
    _log.warning("Go on with the same command and %s resume=true", output)


def objective(settings: TrainSettings, errors: Mapping[str, float]) -> float:
    """Return what a search over settings lessens, mm."""
    return errors.get(settings.best.monitor, math.nan)


COMMAND = Command(
    name="train",
    settings=TrainSettings,
    task=train,
    summary=summary,
    files=files,
    objective=objective,
)


if __name__ == "__main__":
    run_by_name("train")
