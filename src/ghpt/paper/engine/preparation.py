"""The action that prepares the recordings of a data set."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ghpt.config import Target, build, settings
from ghpt.files import write_json


@dataclass(frozen=True)
class SplitSettings:
    """The settings of `prepare_split`."""

    data: Target
    split: str
    files: Mapping[str, Any] = field(default_factory=dict)
    """What identifies the files of a real data set."""


def prepare_split(config: dict[str, Any], dependencies: dict[str, Path], folder: Path) -> None:
    """Have the recordings of a split in the cache of recordings.

    result.json holds their number of frames.
    """
    own = settings(SplitSettings, config)
    recordings = build(own.data, "data").recordings(own.split)
    frames = sum(len(recording) for recording in recordings)
    write_json(folder / "result.json", {"frames": frames})
