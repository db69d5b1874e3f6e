"""Pictures of several people together, made of what was written of each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ghpt.export import WRITERS, Scene
from ghpt.export.together import put_together

_PICTURES = ("html", "rerun")


def write_pictures(
    output: Path, folders: Sequence[Path], name: str, formats: Sequence[str], scene: Scene
) -> None:
    """Write the player and the recording of Rerun that show everybody, where they are asked for.

    Without the npz files of the people they show the first person alone.
    """
    if "npz" not in formats:
        return
    about, chunks = put_together(name, [folder / WRITERS["npz"].file for folder in folders])
    for picture in _PICTURES:
        if picture in formats:
            writer = WRITERS[picture]
            writer.write(output / writer.file, about, chunks, scene=scene)
