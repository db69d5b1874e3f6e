"""What can be typed next on the same input, complete and as a shell takes it."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ghpt.commands.display import as_started, display_path, shell_override
from ghpt.commands.inputs import InputSettings
from ghpt.commands.prediction.verdict import Commands

EXAMPLE_HEIGHT = 1750
"""mm: stands for the person's own."""


def commands_on(inputs: InputSettings, own: Mapping[str, object], output: Path) -> Commands:
    """Return the commands for what predict.py was given; each writes beside ``output``.

    ``own``: the settings of predict.py alone that are to stay as they are.
    """
    given = given_settings(inputs)
    shown = display_path(output)

    def predict(**more: Any) -> str:
        return command_line("predict.py", {**given, **own, **more}, f"{shown}_again")

    scaled = given | {"scale.height": EXAMPLE_HEIGHT}
    return Commands(
        cameras=command_line("cameras.py", given, f"{shown}_checked"),
        calibrate=command_line("calibrate.py", scaled, f"{shown}_calibrated"),
        predict=predict,
    )


def prediction_by(inputs: InputSettings, output: Path, **files: Path) -> str:
    """Return the command that predicts the same input by other ``files``, and writes beside
    ``output``. A recording of a data set keeps its own.
    """
    used = files if inputs.keypoints else {}
    shown = {name: display_path(path) for name, path in used.items()}
    given = given_settings(inputs) | shown
    return command_line("predict.py", given, f"{display_path(output)}_poses")


def given_settings(inputs: InputSettings) -> dict[str, Any]:
    """Return what was given of the settings that all three commands have."""
    keys = [key for key in InputSettings.__annotations__ if key != "data"]
    values = {key: getattr(inputs, key) for key in keys}
    given = {key: value for key, value in values.items() if value is not None}
    if inputs.time == "file":
        del given["time"]
    if not inputs.least_confidence:
        del given["least_confidence"]
    if not inputs.keypoints:
        given |= {"data": inputs.data["name"]}
    return given


def command_line(script: str, values: Mapping[str, object], output: str) -> str:
    """Return a command with these settings that writes into ``output``."""
    words = [setting(key, value) for key, value in values.items()]
    return " ".join([as_started(f"python {script}"), *words, shell_override("output", output)])


def setting(key: str, value: object) -> str:
    """``key=value`` as a shell and Hydra's grammar take it, lists and mappings among the values."""
    if isinstance(value, Mapping):
        pairs = (f"{_key(str(name))}: {_element(of)}" for name, of in value.items())
        return shlex.quote(f"{key}={{{', '.join(pairs)}}}")
    if isinstance(value, list | tuple):
        return shlex.quote(f"{key}={_list(value)}")
    if isinstance(value, float):
        return f"{key}={value:g}"
    return shell_override(key, value)


def _list(values: Iterable[object]) -> str:
    return f"[{','.join(map(_element, values))}]"


def _key(name: str) -> str:
    """A mapping's key, which Hydra's grammar has no quotes for."""
    return re.sub(r"([^\w.-])", r"\\\1", name)


def _element(value: object) -> str:
    """A word of Hydra's grammar; what could be a number, or holds more than letters, is quoted."""
    text = str(value)
    if re.fullmatch(r"[A-Za-z_][\w.-]*", text):
        return text
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
