"""Checkpoints: written whole or not at all, read without running code, and refused with a reason.

A checkpoint is a zip file as ``torch.save`` writes it, and its SHA-256 is the zip's comment, at the
very end. So ``torch.load`` reads it as any other, while here nothing is unpickled before the digest
has been compared.
"""

import hashlib
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import torch
from lightning.fabric.plugins import CheckpointIO
from torch import Tensor

from ghpt.config import check_plain
from ghpt.errors import GhptCheckpointError, GhptConfigError
from ghpt.files import atomic_write, remove
from ghpt.models.module import StochasticEstimator
from ghpt.models.registry import Untrusted, build_registered, check_trust, packages_to_trust

FORMAT_VERSION = 3
FIELD = "ghpt"
"""Where a checkpoint carries what is ours: format_version, config (plain), provenance (plain)."""
LAST = "last.ckpt"
PREVIOUS = "previous.ckpt"
"""Beside ``LAST``: what that was before the newest save."""
_TITLE = b"ghpt sha256 "
_TRAILER = len(_TITLE) + 2 * hashlib.sha256().digest_size
_END = b"PK\x05\x06"
_END_SIZE = 22
"""The last bytes of a zip file without a comment: they begin with ``_END``, and end with two bytes
that are the length of the comment."""
_OURS = "Give one that train.py wrote."
_HINT = "It is damaged or not a ghpt checkpoint; use another one."


class AtomicCheckpointIO(CheckpointIO):
    """Writes a temporary file in the checkpoint's own folder, reads it back, moves it into place.

    Lightning's own goes through the system's temporary folder, which copies without a sync where
    that is another file system: a kill then destroys both the new and the old checkpoint.
    ``storage_options={"previous": path}`` keeps what the new checkpoint replaces under that name.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None
    ) -> None:
        content = io.BytesIO()  # torch.save hides the cause when writing to a file fails
        torch.save(checkpoint, content)
        _sign(content)
        previous = (storage_options or {}).get("previous")
        with atomic_write(path, verify=_read, previous=previous) as handle:
            handle.write(content.getbuffer())

    def load_checkpoint(
        self, path: Any, map_location: Any = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        return read_checkpoint(path, map_location or "cpu")

    def remove_checkpoint(self, path: Any) -> None:
        remove(path)


def _sign(content: io.BytesIO) -> None:
    """Append the digest of what is before, as the comment of the zip file that ``content`` is."""
    view = content.getbuffer()
    if view[-_END_SIZE : 4 - _END_SIZE] != _END or view[-2:] != bytes(2):
        raise RuntimeError("torch.save has written no zip file without a comment")
    view[-2:] = _TRAILER.to_bytes(2, "little")
    digest = hashlib.sha256(view).hexdigest()
    view.release()
    content.seek(0, io.SEEK_END)
    content.write(_TITLE + digest.encode())


def _check_digest(path: Path, handle: IO[bytes]) -> None:
    """Raise GhptCheckpointError unless a file ends in the digest of what is before.

    The handle is left at the file's begin.
    """
    size = handle.seek(0, io.SEEK_END)
    handle.seek(max(size - _TRAILER, 0))
    trailer = handle.read()
    if not trailer.startswith(_TITLE):
        handle.seek(0)
        unsigned = handle.read(4) == b"PK\x03\x04" and trailer[-_END_SIZE : 4 - _END_SIZE] == _END
        problem = "has no digest: ghpt 0.1 wrote it (format version 1), or another program"
        if not unsigned:
            raise GhptCheckpointError(path, "cannot be read (it does not end in a digest)", _HINT)
        raise GhptCheckpointError(path, problem, "Train again, or use it with ghpt 0.1.")
    handle.seek(0)
    digest = hashlib.sha256()
    left = size - _TRAILER
    while left > 0 and (block := handle.read(min(left, 1 << 20))):
        digest.update(block)
        left -= len(block)
    if trailer != _TITLE + digest.hexdigest().encode():
        problem = "cannot be read (its content does not have its digest)"
        raise GhptCheckpointError(path, problem, _HINT)
    handle.seek(0)


def _read(path: Path, map_location: Any = "cpu") -> Any:
    with open(path, "rb") as handle:
        _check_digest(path, handle)
        return torch.load(handle, map_location=map_location, weights_only=True)


def read_checkpoint(path: str | Path, map_location: Any = "cpu") -> dict[str, Any]:
    """Return the checkpoint as a dict, in which ``FIELD`` is plain data and weights are tensors.

    Raises GhptCheckpointError if it is missing, damaged, foreign or of another version.
    """
    try:
        if Path(path).is_dir():
            raise GhptCheckpointError(path, "is a folder", "Give the last.ckpt or best.ckpt in it.")
        if not Path(path).is_file():
            raise GhptCheckpointError(
                path, "there is no such file", "Give the last.ckpt or best.ckpt of a training run."
            )
        checkpoint = _read(Path(path), map_location)
    except GhptCheckpointError:
        raise
    except Exception as error:
        # torch.load's errors are of many kinds: a damaged zip, a truncated pickle, a refused
        # global.
        raise GhptCheckpointError(path, f"cannot be read ({_one_line(error)})", _HINT) from None
    ours = checkpoint.get(FIELD) if isinstance(checkpoint, dict) else None
    if not isinstance(ours, dict) or not _are_weights(checkpoint.get("state_dict")):
        raise GhptCheckpointError(path, "is not a checkpoint of ghpt", _OURS)
    try:
        check_plain(ours, FIELD)
    except GhptConfigError as error:
        problem = f"is not a checkpoint of ghpt ({_one_line(error)})"
        raise GhptCheckpointError(path, problem, _HINT) from None
    found = ours.get("format_version")
    if type(found) is not int or found != FORMAT_VERSION:
        problem = f"has format version {str(found)[:20]}; this is {FORMAT_VERSION}"
        hint = "Use the version of ghpt that wrote it, or train again."
        raise GhptCheckpointError(path, problem, hint)
    return checkpoint


def load_model(
    path: str | Path, trust: Sequence[str] = (), **changes: Any
) -> tuple[StochasticEstimator, dict[str, Any]]:
    """Return the model that a checkpoint describes, and what the checkpoint says of itself.

    ``changes`` replace settings of the model (such as ``hypotheses``, or ``problem.frames``); None
    leaves one as it is. A checkpoint can only name the classes of ``ghpt.models.registry``, and
    those of the packages that ``trust`` names. Raises GhptCheckpointError, and GhptConfigError for
    a change, or a ``trust``, that cannot work.
    """
    check_trust(trust)
    checkpoint = read_checkpoint(path)
    ours = checkpoint[FIELD]
    weights = checkpoint["state_dict"]
    if not isinstance(ours.get("config"), dict) or not isinstance(ours.get("provenance"), dict):
        raise GhptCheckpointError(path, "does not say what it is of", _OURS)
    try:
        config = ours["config"]["model"]
        for name, value in changes.items():
            config = config if value is None else _with_setting(config, name.split("."), value)
        if not packages_to_trust(config):
            # On this device no numbers are kept: a file cannot ask for more memory than it fills.
            with torch.device("meta"):
                check_fit(build_registered(config), weights)
        model = build_registered(config, trust)
        if not isinstance(model, StochasticEstimator):
            raise GhptCheckpointError(path, f"holds a {type(model).__name__}", _OURS)
        check_fit(model, weights)
        model.load_state_dict(weights, strict=True)
    except GhptCheckpointError:
        raise
    except Untrusted as error:
        raise GhptCheckpointError(path, error.problem, error.hint) from None
    except Exception as error:  # a class of the user's own may raise any
        if isinstance(error, GhptConfigError) and error.key.removeprefix("model.") in changes:
            raise
        problem = f"does not fit its own model ({_one_line(error)})"
        hint = "It is of another model or version; train again."
        raise GhptCheckpointError(path, problem, hint) from None
    return model, ours


def check_fit(model: Any, weights: Mapping[str, Tensor]) -> None:
    """Raise ValueError unless these are a model's weights, in its shapes and types, all finite."""
    wanted = model.state_dict()
    if wanted.keys() != weights.keys():
        raise ValueError(f"weights {', '.join(sorted(wanted.keys() ^ weights.keys()))}")
    for name, value in weights.items():
        form = value.dtype, tuple(value.shape)
        wanted_form = wanted[name].dtype, tuple(wanted[name].shape)
        if form != wanted_form:
            raise ValueError(f"{name} is {form}, not {wanted_form}")
        if not torch.isfinite(value).all():
            raise ValueError(f"{name} holds NaN or inf")


def _are_weights(values: Any) -> bool:
    """Return whether this is a dict of names and plain tensors."""
    if not isinstance(values, dict):
        return False
    for name, value in values.items():
        if not (isinstance(name, str) and isinstance(value, Tensor)):
            return False
        if value.layout != torch.strided or value.is_meta:
            return False
    return True


def _one_line(error: Exception) -> str:
    """Return an error's first line, printable and of no great length: it may quote the file."""
    text = str(error).split("\n")[0] or type(error).__name__
    if not isinstance(error, ValueError):
        text = f"{type(error).__name__}: {text}"
    return "".join(c if c.isprintable() else "?" for c in text)[:300]


def _with_setting(config: dict[str, Any], path: list[str], value: Any) -> dict[str, Any]:
    """Return the configuration with one setting changed."""
    name, *rest = path
    new = _with_setting(config[name], rest, value) if rest else value
    return config | {name: new}
