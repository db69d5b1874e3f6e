"""Checkpoints: written whole or not at all, read without running code, and refused with a reason."""

import io
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins import CheckpointIO

from ghpt.config import TRUSTED, build
from ghpt.errors import GhptCheckpointError, GhptConfigError
from ghpt.files import atomic_write
from ghpt.models.module import StochasticEstimator

FORMAT_VERSION = 1
FIELD = "ghpt"
"""Where a checkpoint carries what is ours: format_version, config (plain), provenance (plain)."""


class AtomicCheckpointIO(CheckpointIO):
    """Temporary file in the checkpoint's own folder, synced, read back, moved into place.

    (Lightning's own goes through the system's temporary folder, which copies without a sync where that is another
    file system: a kill then destroys both the new and the old checkpoint.)
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        content = io.BytesIO()  # torch.save hides the cause when writing to a file fails
        torch.save(checkpoint, content)
        with atomic_write(path, verify=_read) as handle:
            handle.write(content.getbuffer())

    def load_checkpoint(self, path: Any, map_location: Any = None, weights_only: bool | None = None) -> dict[str, Any]:
        return read_checkpoint(path, map_location or "cpu")

    def remove_checkpoint(self, path: Any) -> None:
        Path(path).unlink(missing_ok=True)


def _read(path: Path, map_location: Any = "cpu") -> Any:
    return torch.load(path, map_location=map_location, weights_only=True)


def read_checkpoint(path: str | Path, map_location: Any = "cpu") -> dict[str, Any]:
    """The checkpoint as a dict. Raises GhptCheckpointError if it is missing, damaged, foreign or too new."""
    if not Path(path).is_file():
        raise GhptCheckpointError(path, "there is no such file", "Give the last.ckpt or best.ckpt of a training run.")
    try:
        checkpoint = _read(Path(path), map_location)
    except Exception as error:
        # torch.load's errors are of many kinds: a damaged zip, a truncated pickle, a refused global.
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise GhptCheckpointError(
            path,
            f"cannot be read ({reason[:200]})",
            "It is damaged or not a ghpt checkpoint; use another one.",
        ) from None
    ours = checkpoint.get(FIELD) if isinstance(checkpoint, dict) else None
    if not isinstance(ours, dict) or not isinstance(checkpoint.get("state_dict"), dict):
        raise GhptCheckpointError(path, "is not a checkpoint of ghpt", "Give one that train.py wrote.")
    if ours.get("format_version") != FORMAT_VERSION:
        found = ours.get("format_version")
        mend = "Use the version of ghpt that wrote it, or train again."
        raise GhptCheckpointError(path, f"has format version {found}; this is {FORMAT_VERSION}", mend)
    return checkpoint


def load_model(path: str | Path, **changes: Any) -> tuple[StochasticEstimator, dict[str, Any]]:
    """The model that a checkpoint describes, with its weights, and what the checkpoint says of itself.

    ``changes`` replace settings of the model (such as ``hypotheses``, or ``problem.frames``); None leaves one as it is.
    Only classes of ghpt and torch's optimisers can be named by a checkpoint. Raises GhptCheckpointError.
    """
    checkpoint = read_checkpoint(path)
    ours = checkpoint[FIELD]
    try:
        config = ours["config"]["model"]
        for name, value in changes.items():
            config = config if value is None else _changed(config, name.split("."), value)
        model = build(config, "model", packages=TRUSTED)
        model.load_state_dict(checkpoint["state_dict"], strict=True)
    except (KeyError, TypeError, AttributeError, RuntimeError, GhptConfigError) as error:
        if isinstance(error, GhptConfigError) and error.key.removeprefix("model.") in changes:
            raise
        reason = str(error).splitlines()[0][:300]
        mend = "It is of another model or version; train again."
        raise GhptCheckpointError(path, f"does not fit its own model ({reason})", mend) from None
    if not isinstance(model, StochasticEstimator):
        raise GhptCheckpointError(path, f"holds a {type(model).__name__}", "Give one that train.py wrote.")
    return model, ours


def _changed(config: dict[str, Any], path: list[str], value: Any) -> dict[str, Any]:
    """The configuration with one setting changed."""
    name, *rest = path
    return config | {name: _changed(config[name], rest, value) if rest else value}
