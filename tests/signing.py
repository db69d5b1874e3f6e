"""Checkpoints that end in the digest of what is in them, whatever that is: what an attacker can
make.
"""

import hashlib
import io
import zipfile
from pathlib import Path
from typing import Any

import torch

from ghpt.models.checkpoint import FORMAT_VERSION

TITLE = b"ghpt sha256 "


def signed(content: bytes) -> bytes:
    """The content and its digest; a zip file stays one."""
    if content[-22:-18] == b"PK\x05\x06":
        content = content[:-2] + (len(TITLE) + 64).to_bytes(2, "little")
    return content + TITLE + hashlib.sha256(content).hexdigest().encode()


def save_signed(value: Any, path: Path, **options: Any) -> None:
    """What ``torch.save`` writes, signed."""
    content = io.BytesIO()
    torch.save(value, content, **options)
    path.write_bytes(signed(content.getvalue()))


def save_pickle(pickled: bytes, path: Path) -> None:
    """A file of torch's form around a pickle that torch would not write."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr("archive/data.pkl", pickled)
        archive.writestr("archive/byteorder", "little")
        archive.writestr("archive/version", "3\n")
    path.write_bytes(signed(content.getvalue()))


def text(value: str) -> bytes:
    """The pickle of a text."""
    encoded = value.encode()
    return b"X" + len(encoded).to_bytes(4, "little") + encoded


def checkpoint_around(model: bytes) -> bytes:
    """The pickle of a checkpoint whose model's configuration is this pickle."""
    config = text("config") + b"}(" + text("model") + model + b"u"
    version = b"K" + bytes([FORMAT_VERSION])
    ours = text("format_version") + version + text("provenance") + b"}" + config
    return b"\x80\x02}(" + text("state_dict") + b"}" + text("ghpt") + b"}(" + ours + b"uu."
