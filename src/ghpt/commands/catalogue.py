"""The commands by name. A command's module, and PyTorch with it, is imported when its job runs."""

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ghpt.config import CONF

if TYPE_CHECKING:
    from ghpt.commands.app import Command

SUMMARIES = {
    "demo": "A synthetic person through calibrate, predict and the player: no file is needed.",
    "detect": "From videos to 2D key points of one person, by MediaPipe.",
    "train": "Train a scorer on one camera arrangement; it then works on any other.",
    "test": "Test a trained model on any cameras: tables, figures and predictions.",
    "predict": "From 2D key points and calibrated cameras to 3D poses.",
    "calibrate": "Calibrate cameras from the people they see, whose intrinsics are known.",
    "cameras": "Check given cameras against the people they see.",
    "reproduce": "Make every table and figure of the paper again.",
}
"""What each command does, in one line."""


def run_by_name(name: str) -> None:
    """Run a command with the project's own configuration and the words of ``sys.argv``."""
    from ghpt.commands.app import run

    run(CONF, name)


def load(name: str, conf: Path) -> "Command[Any, Any]":
    """Import a command. ``conf`` is the folder of its configuration."""
    module = importlib.import_module(f"ghpt.commands.{name}")
    if name == "reproduce":  # which composes the configurations of trainings and tests itself
        return module.command(conf)
    return module.COMMAND
