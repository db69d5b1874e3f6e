"""The action that tests a model."""

from pathlib import Path
from typing import Any

from ghpt.commands.test import TestSettings, measure
from ghpt.config import settings
from ghpt.models.checkpoint import LAST


def measure_model(config: dict[str, Any], dependencies: dict[str, Path], folder: Path) -> None:
    """Write metrics.json and predictions.npz of the dependency ``model``, as test.py does."""
    own = {
        "progress_bar": False,
        "ckpt": str(dependencies["model"] / LAST),
        "output": str(folder),
    }
    values = {key: value for key, value in config.items() if key != "files"}
    measure(settings(TestSettings, values | own), folder)
