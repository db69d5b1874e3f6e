"""The checkpoint from which a training goes on."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ghpt.commands.display import display_path
from ghpt.errors import GhptCheckpointError
from ghpt.models.checkpoint import FIELD, LAST, PREVIOUS, check_fit, read_checkpoint
from ghpt.models.module import StochasticEstimator

_STATE: Mapping[str, type] = {
    "epoch": int,
    "global_step": int,
    "loops": dict,
    "callbacks": dict,
    "optimizer_states": list,
    "lr_schedulers": list,
    "pytorch-lightning_version": str,
}
"""What Lightning needs of a checkpoint to go on from it."""
_NO_MATTER = "workers"
"""The setting of the data that decides no number, which one may have to change to go on."""
_OURS = "Give one that train.py wrote."


class OtherSettings(GhptCheckpointError):
    """A checkpoint that is whole, and of another training."""


@dataclass(frozen=True)
class Start:
    """Where a training begins."""

    checkpoint: Path | None = None
    """None: at the beginning."""
    warning: str = ""
    """Why this is not the last checkpoint; empty where it is."""


def resumable(output: Path, settings: Mapping[str, Any], model: StochasticEstimator) -> Start:
    """Return the checkpoint in ``output`` to go on from: the last, or the previous one.

    ``settings``: ``model``, ``data`` and ``seed``, as the checkpoint must have them. Raises
    GhptCheckpointError if neither can be used, or if the one that can is of other settings.
    """
    last = output / LAST
    previous = output / PREVIOUS
    try:
        _check_resumable(last, settings, model)
        return Start(last)
    except OtherSettings:
        raise
    except GhptCheckpointError as error:
        if not previous.exists():
            raise
        reason = f"{display_path(last)}: {error.problem}"
    try:
        step = _check_resumable(previous, settings, model)
    except OtherSettings:
        raise
    except GhptCheckpointError as error:
        problem = f"{reason}; {previous.name}: {error.problem}"
        hint = "There is nothing to go on from: train without resume=true, in another output."
        raise GhptCheckpointError(output, problem, hint) from None
    warning = f"{reason}. Going on from {previous.name}, which holds training step {step}."
    return Start(previous, warning)


def _check_resumable(path: Path, settings: Mapping[str, Any], model: StochasticEstimator) -> int:
    """Return a checkpoint's step. Raises GhptCheckpointError if it cannot be gone on from."""
    checkpoint = read_checkpoint(path)
    saved = checkpoint[FIELD].get("config")
    if not isinstance(saved, dict):
        raise GhptCheckpointError(path, "does not say what it is of", _OURS)
    for part, wanted in settings.items():
        if part not in saved or _decisive(saved[part]) != _decisive(wanted):
            problem = f"was made with other settings of {part!r}"
            raise OtherSettings(path, problem, "Resume with the same ones.")
    for name, kind in _STATE.items():
        state = checkpoint.get(name)
        if type(state) is not kind or (name == "optimizer_states" and not state):
            raise GhptCheckpointError(path, f"holds no state of a training ({name})", _OURS)
    try:
        check_fit(model, checkpoint["state_dict"])
    except ValueError as error:
        raise GhptCheckpointError(path, f"does not fit its own model ({error})", _OURS) from None
    return checkpoint["global_step"]


def _decisive(settings: Any) -> Any:
    """Return the settings that decide numbers."""
    if not isinstance(settings, dict):
        return settings
    return {name: value for name, value in settings.items() if name != _NO_MATTER}
