"""How paths and settings are said, so that a reader can type them."""

import os
import re
from pathlib import Path


def display_path(path: Path) -> str:
    """Return a path as short as it can be typed here."""
    relative = os.path.relpath(path)
    return str(path) if relative.startswith("..") else relative


def shell_override(key: str, value: object) -> str:
    """Return ``key=value`` as a shell and Hydra's grammar take it."""
    text = f"{key}={value}"
    return text if re.fullmatch(r"[\w=./+-]+", text) else f"\"{key}='{value}'\""
