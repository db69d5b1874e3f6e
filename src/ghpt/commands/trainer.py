"""Lightning's Trainer, as the yaml has it."""

from collections.abc import Mapping
from typing import Any

import lightning as L
from lightning.fabric.utilities.exceptions import MisconfigurationException

from ghpt.commands.lost import OwnSignals
from ghpt.config import build, check_arguments
from ghpt.errors import GhptConfigError
from ghpt.models.callbacks import Progress


def make_trainer(settings: Mapping[str, Any], **ours: Any) -> L.Trainer:
    """Return Lightning's Trainer of the yaml's settings and ``ours``.

    Raises GhptConfigError for what it does not take.
    """
    built = build(settings, "trainer")
    ours["callbacks"] = [*ours.get("callbacks", ()), OwnSignals()]
    for key in set(built) & set(ours):
        problem = "is not for the configuration: ghpt sets it"
        raise GhptConfigError(f"trainer.{key}", problem, "Leave it out.")
    check_arguments(L.Trainer, built, "trainer")
    try:
        return L.Trainer(**built, **ours, use_distributed_sampler=False)
    except (TypeError, ValueError, MisconfigurationException) as error:
        hint = "See lightning.Trainer's arguments."
        raise GhptConfigError("trainer", str(error).rstrip("."), hint) from error


def progress(shown: bool) -> list[L.Callback]:
    """Return the callbacks of the progress bar, none where it is not shown."""
    return [Progress()] if shown else []
