"""A small data set of random people seen by a random rig, for tests of everything above the
data."""

from collections.abc import Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from blank import blank_figures
from ghpt.data.datasets.datamodule import KeyPointDataModule
from ghpt.geometry.cameras import Cameras, project
from ghpt.observations import LabelledRecording

DATA = {
    "_target_": "toys.ToyData",
    "name": "toy",
    "root": None,
    "cache": None,
    "seed": 0,
    "train_samples": 80,
    "least_joints": 5,
    "stride": 3,
    "evaluate": "test",
    "batch_size": 16,
    "workers": 0,
    "views": 4,
    "missing": 0.1,
}

MODEL = {
    "_target_": "ghpt.models.module.StochasticEstimator",
    "problem": {
        "_target_": "ghpt.models.pose.problem.PoseTriangulation",
        "coordinates": True,
        "lengths": True,
    },
    "scorer": {
        "_target_": "ghpt.models.scorer.Scorer",
        "_partial_": True,
        "layers": [32, 16],
        "clip": 10.0,
        "bfloat16": False,
    },
    "loss": {
        "_target_": "ghpt.models.loss.StochasticLoss",
        "alpha": 1.0,
        "beta": 0.01,
        "gamma": 0.02,
        "relative_errors": True,
    },
    "optimizer": {"_target_": "torch.optim.Adam", "_partial_": True, "lr": 1e-3},
    "hypotheses": 12,
    "temperature": 1.5,
    "gumbel": True,
    "logit_std_cap": 1.5,
    "selection": "weight",
    "seed": 0,
}

TRAINER = {
    "accelerator": "cpu",
    "devices": 1,
    "max_epochs": 2,
    "log_every_n_steps": 1,
    "enable_model_summary": False,
}

TRAIN = {
    "data": DATA,
    "model": MODEL,
    "trainer": TRAINER,
    "seed": 0,
    "save_every": 1000,
    "resume": False,
    "progress_bar": False,
}


def train(config: Mapping[str, Any], output: Path) -> dict[str, float]:
    """Train as train.py does, with a plain configuration."""
    from ghpt.commands.train import TrainSettings, train
    from ghpt.config import settings

    return train(settings(TrainSettings, config | {"output": str(output)}), output)


def run_test(config: Mapping[str, Any], output: Path) -> Any:
    """Test as test.py does, with blank figures; of the configuration, which may be a training's,
    what a test takes.
    """
    from ghpt.commands.test import TestSettings, test
    from ghpt.config import settings

    names = {field.name for field in fields(TestSettings)}
    values = {"hypotheses": None, "frames": None, "output": str(output)}
    values |= {name: value for name, value in config.items() if name in names}
    with blank_figures():
        return test(settings(TestSettings, values), output)


class ToyData(KeyPointDataModule):
    """Random bodies around the origin; key points with noise of 5 px, some of them missing."""

    def __init__(self, views: int, missing: float, **settings: Any) -> None:
        super().__init__(**settings)
        self.views, self.missing = views, missing

    def cache_key(self, split: str) -> dict[str, Any]:
        return {"name": f"toy-{split}", "views": self.views, "missing": self.missing}

    def generate(self, split: str) -> Iterable[LabelledRecording]:
        rng = np.random.default_rng(["train", "validation", "test"].index(split))
        for take in range(2):
            yield recording(
                f"S{take}/Walking-1",
                f"S{take}",
                60 if split == "train" else 45,
                self.views,
                self.missing,
                rng,
            )


def recording(
    name: str, subject: str, frames: int, views: int, missing: float, rng: np.random.Generator
) -> LabelledRecording:
    angles = np.linspace(0, 2 * np.pi, views, endpoint=False)
    R = torch.from_numpy(
        np.stack([Rotation.from_euler("yx", [a, 0.2]).as_matrix() for a in angles])
    )
    K = torch.tensor([[1100.0, 0, 500], [0, 1100, 500], [0, 0, 1]], dtype=torch.float64).expand(
        views, 3, 3
    )
    cameras = Cameras(K, R, torch.tensor([0.0, 0, 5000], dtype=torch.float64).expand(views, 3))
    body = rng.normal(0, 400, (17, 3))
    truth = body + rng.normal(0, 60, (frames, 17, 3))
    pixels, _ = project(cameras, torch.from_numpy(truth))
    valid = rng.random((frames, views, 17)) >= missing
    return LabelledRecording(
        name=name,
        subject=subject,
        action="Walking",
        rate_hz=50.0,
        camera_names=tuple(f"c{i}" for i in range(views)),
        cameras=cameras,
        key_points=(pixels.numpy() + rng.normal(0, 5, pixels.shape)).astype(np.float32),
        confidence=rng.random((frames, views, 17), dtype=np.float32),
        valid=valid,
        truth=truth.astype(np.float32),
        truth_valid=np.ones((frames, 17), bool),
        frame=np.arange(frames),
    )
