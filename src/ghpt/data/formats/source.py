"""What a user says of the key points that are to be read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ghpt.data.formats.names import Name


@dataclass(frozen=True)
class Source:
    """A folder or file of key points; what is None is told by the files."""

    path: Path
    skeleton: str | None = None
    session: Name = None
    """Of several recordings in a folder, which."""
    format: str | None = None
