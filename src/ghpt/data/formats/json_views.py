"""JSON files with all frames of a view in one: which view a file is, and what all such formats
share.
"""

from __future__ import annotations

import re
from pathlib import Path

from ghpt.data.formats.validate import check_view_count
from ghpt.errors import GhptDataError

_PREFIXES = re.compile(r"^(results|predictions|alphapose-results)[_.-](?=.)")


def json_files(path: Path) -> list[Path]:
    """The JSON files of a folder, by name, or the file itself. Raises GhptDataError if there is
    none.
    """
    files = sorted(path.glob("*.json")) if path.is_dir() else [path]
    if not files:
        raise GhptDataError(
            path,
            "",
            "holds no JSON file",
            "Put a file for each camera there: cam1.json, cam2.json.",
        )
    check_view_count(path, len(files))
    return files


def view_name(path: Path) -> str:
    """The file's name without its ending and without a tool's prefix: ``results_cam1.json`` is
    ``cam1``.
    """
    return _PREFIXES.sub("", path.stem)
