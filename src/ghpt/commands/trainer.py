"""Lightning's Trainer, as the yaml has it."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.loggers import Logger, TensorBoardLogger

from ghpt.commands.lost import OwnSignals
from ghpt.config import build, check_arguments
from ghpt.errors import GhptConfigError, check, one_line
from ghpt.extras import EXTRAS, NotInstalled
from ghpt.models.callbacks import Progress

_PRECISIONS = ("32-true", "bf16-mixed", "16-mixed")
"""How the scorer may calculate; geometry is in float64 whatever is said."""


def make_trainer(settings: Mapping[str, Any], **ours: Any) -> L.Trainer:
    """Return Lightning's Trainer of the yaml's settings and ``ours``.

    Raises GhptConfigError for what it does not take.
    """
    built = build(settings, "trainer")
    ours["callbacks"] = [*ours.get("callbacks", ()), OwnSignals()]
    for key in set(built) & set(ours):
        problem = "is not for the configuration: ghpt sets it"
        raise GhptConfigError(f"trainer.{key}", problem, "Leave it out.")
    precision = built.get("precision", _PRECISIONS[0])
    hint = f"Existing: {', '.join(_PRECISIONS)}."
    check(precision in _PRECISIONS, "trainer.precision", f"is {precision!r}", hint)
    accelerator = built.get("accelerator")
    problem = f"is {accelerator}, and this machine has none that PyTorch can use"
    check(_is_available(accelerator), "trainer.accelerator", problem, "Take trainer=cpu.")
    check_arguments(L.Trainer, built, "trainer")
    try:
        return L.Trainer(**built, **ours, use_distributed_sampler=False)
    except (TypeError, ValueError, MisconfigurationException) as error:
        hint = "See lightning.Trainer's arguments."
        raise GhptConfigError("trainer", str(error).rstrip(".!"), hint) from error


def _is_available(accelerator: object) -> bool:
    """Return whether a graphics processor that is asked for is there."""
    nvidia = torch.cuda.is_available()
    apple = torch.backends.mps.is_available()
    there = {"gpu": nvidia or apple, "cuda": nvidia, "mps": apple}
    return there.get(str(accelerator), True)


def progress(shown: bool) -> list[L.Callback]:
    """Return the callbacks of the progress bar, none where it is not shown."""
    return [Progress()] if shown else []


def make_loggers(settings: Mapping[str, Any], output: Path) -> list[Logger]:
    """Return the loggers of the yaml's settings, which write into ``output``.

    Raises GhptConfigError for what they do not take, and NotInstalled for a missing package.
    """
    loggers = []
    for name, logger in build(settings, "logger").items():
        key = f"logger.{name}"
        with in_our_words(key):
            loggers.append(logger(save_dir=str(output)))
        if not isinstance(loggers[-1], TensorBoardLogger):
            _open(loggers[-1], key)
    return loggers


def _open(logger: Logger, key: str) -> None:
    """Let a logger connect or write before the training. Raises GhptConfigError if it cannot."""
    try:
        getattr(logger, "experiment", None)
    except Exception as error:  # a server that is not there, an account, a version: of many kinds
        hint = "Change its settings, or take another logger."
        raise GhptConfigError(key, one_line(error)[:300].rstrip("."), hint) from error


@contextmanager
def in_our_words(key: str = "trainer") -> Iterator[None]:
    """Within the block, what Lightning says of settings names the ``key`` that they stand under."""
    try:
        yield
    except ModuleNotFoundError as error:
        missing = next((name for name in EXTRAS if name in str(error)), None)
        if missing is None:
            raise
        raise NotInstalled(key, missing) from error
    except MisconfigurationException as error:
        hint = "Change this setting."
        raise GhptConfigError(key, one_line(error).rstrip(".!"), hint) from error
