"""What the tasks of one seed share, and how the commonest of them are made."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra

from ghpt.commands.display import shell_override
from ghpt.config import build, plain
from ghpt.paper.engine.settings import Overrides, Sizes
from ghpt.paper.engine.tasks import Task

PREPARATION = "ghpt.paper.engine.preparation.prepare_split"
TRAINING = "ghpt.paper.engine.training.train_model"
TESTING = "ghpt.paper.engine.testing.measure_model"
TEST_SECONDS = {"h36m": 40.0}
"""Seconds of a test of the pose, where it is not ``OTHER_SECONDS``."""
OTHER_SECONDS = 13.0
SPLITS = ("train", "validation", "test")


@functools.cache
def compose(conf: Path, name: str, overrides: tuple[str, ...]) -> Mapping[str, Any]:
    """Return ``<conf>/<name>.yaml`` under ``overrides`` as plain data. Do not change it."""
    with contextlib.ExitStack() as stack:
        # Under a command Hydra is initialised, and its folder is ``conf`` too.
        if not GlobalHydra.instance().is_initialized():
            folder = str(conf.resolve())
            stack.enter_context(hydra.initialize_config_dir(folder, version_base="1.3"))
        return plain(hydra.compose(name, [*overrides, "output=unused", "progress_bar=false"]))


@dataclass(frozen=True)
class Setup:
    """Makes tasks. All paths of real data and all sizes come from conf/reproduce.yaml."""

    conf: Path
    roots: Mapping[str, str | None]
    """``human36m`` and ``panoptic``: folder of the real data set, None for the synthetic one."""
    overrides: Overrides
    sizes: Sizes
    seed: int

    def root(self, data: str) -> str | None:
        """Return the folder of a real data set, None for a synthetic one."""
        return self.roots["human36m" if data == "h36m" else "panoptic"]

    def source(self, data: str) -> str:
        """Return the source as metrics.json has it: ``synthetic``, or the path of the real data."""
        root = self.root(data)
        return "synthetic" if root is None else str(Path(root).expanduser().resolve())

    def words(self, data: str, *overrides: str) -> tuple[str, ...]:
        """Return what a command line says of the data and the seed, and ``overrides``."""
        root = self.root(data)
        folder = [] if root is None else [shell_override("data.root", root)]
        return (f"data={data}", *folder, f"seed={self.seed}", *overrides)

    def configuration(self, name: str, data: str, *overrides: str) -> dict[str, Any]:
        """Return a command's whole configuration, and of real data what identifies the files."""
        config = compose(self.conf, name, self.words(data, "trainer.devices=1", *overrides))
        unused = ("output", "progress_bar")
        return _without(config, unused) | self._identity(data)

    def _identity(self, data: str) -> dict[str, Any]:
        """Return what identifies the files of a real data set."""
        if self.root(data) is None:
            return {}
        return {"files": _cache_keys(self.conf, self.words(data))}

    def preparation(self, data: str, split: str) -> Task:
        """Return the task that has the recordings of a split in the cache."""
        settings = self.configuration("test", data)["data"]
        # Settings that do not change the recordings have one value, so that seeds share them.
        shared = settings | {"seed": 0, "evaluate": "test", "stride": 64}
        config = {"data": shared, "split": split} | self._identity(data)
        return Task(f"prepare-{data}-{split}", PREPARATION, config, seconds=8.0)

    def training(
        self, data: str, *overrides: str, name: str = "", model: str = "pose", seconds: float = 30.0
    ) -> Task:
        """Return the training of a model on a data set.

        ``overrides`` are those of train.py; ``name`` tells trainings with different ones apart.
        """
        words = (f"model={model}", *self.overrides.train, *overrides)
        config = _without(self.configuration("train", data, *words), ("save_every", "resume"))
        dependencies = {split: self.preparation(data, split) for split in ("train", "validation")}
        name = _join("train", model, data, name, f"seed{self.seed}")
        command = _command("train.py", *self.words(data), *words, f"output={_folder(name)}")
        return Task(name, TRAINING, config, dependencies, command, seconds)

    def test(
        self,
        model: Task,
        data: str,
        *overrides: str,
        name: str = "",
        baselines: bool = True,
        seconds: float | None = None,
    ) -> Task:
        """Return the test of the model of a `training` task on a data set.

        ``overrides`` are those of test.py. ``baselines`` False leaves the estimators out that are
        beside the model.
        """
        overrides = (*self.overrides.test, *overrides)
        config = self.configuration("test", data, *overrides)
        of_pairs = "frames" in model.config["model"]["problem"]
        unused = ("baselines",) if of_pairs else ("camera_baselines",)
        config = _without(config, ("ckpt", "trajectory", *unused))
        for key in ("baselines", "camera_baselines"):
            if key in config and not baselines:
                config[key] = {}
        dependencies = {"model": model, "data": self.preparation(data, config["data"]["evaluate"])}
        trained = model.name.removeprefix("train-").removesuffix(f"-seed{self.seed}")
        name = _join("test", trained, "on", data, name, f"seed{self.seed}")
        checkpoint = f"ckpt={_folder(model.name)}/last.ckpt"
        words = (checkpoint, *self.words(data), *overrides, f"output={_folder(name)}")
        seconds = seconds or TEST_SECONDS.get(data, OTHER_SECONDS)
        return Task(name, TESTING, config, dependencies, _command("test.py", *words), seconds)


def _without(config: Mapping[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    return {name: value for name, value in config.items() if name not in names}


def _join(*parts: str) -> str:
    return "-".join(part for part in parts if part)


def _command(script: str, *words: str) -> str:
    return " ".join(["python", script, *words])


def _folder(name: str) -> str:
    """Return where a command that one types puts the run."""
    return f"runs/{name}"


@functools.cache
def _cache_keys(conf: Path, words: tuple[str, ...]) -> dict[str, Any]:
    """Return the key of each split: it changes when a file of the real data set does."""
    data = build(compose(conf, "test", words)["data"], "data")
    return {split: data.cache_key(split) for split in SPLITS}
