"""tab:hyperparameters, read from the composed configuration (paper, appendix C)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ghpt.paper.engine.artefact import Results, Section
from ghpt.paper.engine.setup import Setup, compose
from ghpt.paper.published import HYPERPARAMETERS
from ghpt.report.document import Paragraph, Table
from ghpt.report.tables import NONE

HEADER = ["", "3D pose, paper", "3D pose, ours", "camera, paper", "camera, ours"]


def hyperparameters(results: Results) -> Section:
    """Return the section of the table; it needs no task."""
    pose = _settings(results.setup, "pose")
    camera = _settings(results.setup, "camera")
    rows = [
        [name, paper_pose or NONE, pose[name], paper_camera or NONE, camera[name]]
        for name, (paper_pose, paper_camera) in HYPERPARAMETERS.items()
    ]
    text = (
        "Read from the composed configuration. The paper prints the learning rates as 5*10e-4 and "
        "10e-5; the authors' code has 0.0005 for the pose."
    )
    return Section("settings, no data", [Paragraph(text), Table(HEADER, rows)])


def _settings(setup: Setup, model: str) -> dict[str, str]:
    """Return the table's rows for one model's configuration, as text by their names."""
    words = (f"model={model}", "data=h36m", *setup.overrides.train)
    config = compose(setup.conf, "train", words)

    def value(*keys: str) -> Any:
        return _lookup(config, keys)

    samples = value("data", "train_samples")
    epochs = value("trainer", "max_epochs")
    loss = [value("model", "loss", name) for name in ("alpha", "beta", "gamma")]
    layers = value("model", "scorer", "layers")
    frames = value("model", "problem").get("frames", NONE)
    return {
        "learning rate": f"{value('model', 'optimizer', 'lr'):g}",
        "temperature": str(value("model", "temperature")),
        "alpha, beta, gamma": ", ".join(map(str, loss)),
        "layers": ", ".join(map(str, layers)),
        "hypotheses": str(value("model", "hypotheses")),
        "batch size": str(value("data", "batch_size")),
        "frames M": str(frames),
        "training samples": f"{samples}" if epochs == 1 else f"{samples}, {epochs} times",
    }


def _lookup(config: Any, keys: Sequence[str]) -> Any:
    """Return the value under the keys of a configuration."""
    for key in keys:
        config = config[key]
    return config
