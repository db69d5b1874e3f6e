"""The action that prepares the recordings of a data set."""

from pathlib import Path
from typing import Any

from ghpt.config import build
from ghpt.files import write_json


def prepare_split(config: dict[str, Any], dependencies: dict[str, Path], folder: Path) -> None:
    """Have the recordings of the settings' ``data`` and ``split`` in the cache of recordings.

    result.json holds their number of frames.
    """
    recordings = build(config["data"], "data").recordings(config["split"])
    frames = sum(len(recording) for recording in recordings)
    write_json(folder / "result.json", {"frames": frames})
