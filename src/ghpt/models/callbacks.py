"""When checkpoints are written."""

import signal
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Literal

import lightning as L
from lightning.pytorch.callbacks import Callback, ModelCheckpoint, RichProgressBar
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities.exceptions import SIGTERMException

from ghpt.errors import check
from ghpt.models.checkpoint import FIELD, PREVIOUS

_HANG_UP = getattr(signal, "SIGHUP", None)
"""Windows has none."""


class SaveLast(Callback):
    """Keep ``last.ckpt`` up to date: every ``every`` steps, after each epoch, and when stopped.

    What it held before is ``previous.ckpt``, so that there is a way back if the disk damages it.
    ``resumed``: ``last.ckpt`` is there and whole, because this run goes on from it. (Otherwise what
    stands there is damaged or of another run, and does not become the previous one.)
    SIGINT (Ctrl-C), SIGTERM and SIGHUP (the terminal is closed) take effect after the running step,
    so that what is saved is whole, and in all processes at the same one; a second signal takes
    effect at once. (Lightning's own handler of SIGTERM has the processes wait for each other where
    they are, which with two or more is for ever.)
    ``identity`` is what every checkpoint says of itself.
    """

    def __init__(
        self,
        path: Path,
        every: int,
        identity: dict[str, Any],
        resumed: bool = False,
    ) -> None:
        check(every >= 1, "save_every", f"is {every}", "It must be >= 1 step.")
        self.path = path
        self.every = every
        self.identity = identity
        self.resumed = resumed
        self.interrupted = False
        self.saved: int | None = None
        """The optimiser step that ``last.ckpt`` holds, if this run wrote it."""
        self._stop: type[BaseException] = KeyboardInterrupt
        self._previous: dict[int, Any] = {}

    def on_save_checkpoint(
        self, trainer: L.Trainer, module: L.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        checkpoint[FIELD] = self.identity

    def on_train_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        numbers = [signal.SIGINT, signal.SIGTERM]
        # Under nohup that signal is ignored already, and stays so.
        if _HANG_UP is not None and signal.getsignal(_HANG_UP) != signal.SIG_IGN:
            numbers.append(_HANG_UP)
        for number in numbers:
            with suppress(
                ValueError
            ):  # not in the main thread: then nobody sends us signals either
                self._previous[number] = signal.signal(number, self._interrupt)

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        self._stop = KeyboardInterrupt if number == signal.SIGINT else SIGTERMException
        # A terminal that is closed sends SIGHUP, and its shell once more: that is one signal.
        if self.interrupted and number != _HANG_UP:
            raise self._stop
        self.interrupted = True

    def on_train_batch_end(self, trainer: L.Trainer, *_: Any) -> None:
        if trainer.world_size > 1:  # or one process would wait for the others' part of a checkpoint
            self.interrupted = trainer.strategy.reduce_boolean_decision(self.interrupted, all=False)
        # Not between an epoch's last step and its validation: resumed there, Lightning would skip
        # the validation.
        if not trainer.is_last_batch:
            self._save(trainer, due=trainer.global_step % self.every == 0)

    def on_train_epoch_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self._save(trainer, due=True)

    def _save(self, trainer: L.Trainer, due: bool) -> None:
        if due or self.interrupted:
            whole = self.resumed or self.saved is not None
            options = {"previous": self.path.with_name(PREVIOUS)} if whole else None
            trainer.save_checkpoint(self.path, weights_only=False, storage_options=options)
            self.saved = trainer.global_step
        if self.interrupted:
            raise self._stop

    def teardown(self, trainer: L.Trainer, module: L.LightningModule, stage: str) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous.clear()


class LogHyperparameters(Callback):
    """Shows the settings beside the final validation errors."""

    def __init__(self, values: dict[str, Any]) -> None:
        self.values = values

    def on_fit_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Write them, at the end of training."""
        final = {}
        for name, value in trainer.callback_metrics.items():
            if name.startswith("validation/"):
                final[name] = value.item()
        for logger in trainer.loggers if final else ():
            if isinstance(logger, TensorBoardLogger):
                logger.log_hyperparams(self.values, final)
            else:
                logger.log_hyperparams(self.values)


class Progress(RichProgressBar):
    """Lightning's bar, short enough for 80 columns."""

    def get_metrics(self, trainer: L.Trainer, module: L.LightningModule) -> dict[str, Any]:
        """Return the newest validation error of ``weight``."""
        error = trainer.progress_bar_metrics.get("validation/weight")
        return {} if error is None else {"mm": f"{error:.1f}"}


@dataclass(frozen=True)
class Best:
    """Which epoch is the best: the one with the least, or the greatest, of a metric."""

    monitor: str = "validation/weight"
    mode: Literal["min", "max"] = "min"


def best_checkpoint(folder: Path, best: Best) -> ModelCheckpoint:
    """Return the callback that keeps ``best.ckpt``."""
    return ModelCheckpoint(
        dirpath=folder,
        filename="best",
        monitor=best.monitor,
        mode=best.mode,
        enable_version_counter=False,
    )
