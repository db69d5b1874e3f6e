"""What the tasks of one seed share, and how the commonest of them are asked for."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra

from ghpt.commands.train import shell_override
from ghpt.config import build, plain
from ghpt.paper.engine.tasks import Task

SECONDS = {"h36m": 40.0}
"""Of a test of the pose, where it is not 13."""


@functools.cache
def compose(conf: Path, name: str, overrides: tuple[str, ...]) -> dict[str, Any]:
    """``<conf>/<name>.yaml`` under ``overrides``, as plain data. Do not change it."""
    with contextlib.ExitStack() as stack:
        if (
            not GlobalHydra.instance().is_initialized()
        ):  # as it is under a command, whose folder is ``conf`` too
            stack.enter_context(
                hydra.initialize_config_dir(str(conf.resolve()), version_base="1.3")
            )
        return plain(hydra.compose(name, [*overrides, "output=unused", "progress_bar=false"]))


@dataclass(frozen=True)
class Setup:
    """Makes tasks. All paths of real data and all sizes come from conf/reproduce.yaml."""

    conf: Path
    roots: Mapping[str, str | None]
    """``human36m`` and ``panoptic``: folder of the real data set, None for the synthetic one."""
    overrides: Mapping[str, Sequence[str]]
    """``train``: of every training, in the words of train.py's command line; ``test``: of every
    test.
    """
    sizes: Mapping[str, Any]
    """``conf/reproduce.yaml``'s ``sizes``."""
    seed: int

    def root(self, data: str) -> str | None:
        return self.roots["human36m" if data == "h36m" else "panoptic"]

    def source(self, data: str) -> str:
        """As metrics.json has it: ``synthetic``, or the path of the real data."""
        root = self.root(data)
        return "synthetic" if root is None else str(Path(root).expanduser().resolve())

    def words(self, data: str, *overrides: str) -> tuple[str, ...]:
        """What a command line says of the data and the seed."""
        root = self.root(data)
        return (
            f"data={data}",
            *([] if root is None else [shell_override("data.root", root)]),
            f"seed={self.seed}",
            *overrides,
        )

    def composed(self, name: str, data: str, *overrides: str) -> dict[str, Any]:
        """A command's whole configuration; of real data also what identifies the files."""
        config = compose(self.conf, name, (*self.words(data), "trainer.devices=1", *overrides))
        config = {
            key: value for key, value in config.items() if key not in ("output", "progress_bar")
        }
        return config | (
            {} if self.root(data) is None else {"files": _files(self.conf, self.words(data))}
        )

    def prepared(self, data: str, split: str) -> Task:
        """The recordings of a split in the cache."""
        config = {"data": _of_source(self.composed("test", data)["data"]), "split": split}
        files = {} if self.root(data) is None else {"files": _files(self.conf, self.words(data))}
        return Task(
            f"prepare-{data}-{split}",
            "ghpt.paper.engine.preparation.prepare_split",
            config | files,
            seconds=8.0,
        )

    def trained(
        self, data: str, *overrides: str, name: str = "", model: str = "pose", seconds: float = 30.0
    ) -> Task:
        """A model trained on a data set; ``overrides`` are those of train.py, ``name`` tells them
        apart.
        """
        words = (f"model={model}", *self.overrides["train"], *overrides)
        config = {
            k: v
            for k, v in self.composed("train", data, *words).items()
            if k not in ("save_every", "resume")
        }
        dependencies = {split: self.prepared(data, split) for split in ("train", "validation")}
        name = "-".join(filter(None, ["train", model, data, name, f"seed{self.seed}"]))
        command = " ".join(["python train.py", *self.words(data), *words, _output(name)])
        return Task(
            name, "ghpt.paper.engine.training.train_model", config, dependencies, command, seconds
        )

    def tested(
        self,
        model: Task,
        data: str,
        *overrides: str,
        name: str = "",
        baselines: bool = True,
        view_weights: bool = True,
        seconds: float | None = None,
    ) -> Task:
        """The model of a `trained` task on a data set; ``baselines`` False leaves the classical
        estimators out, ``view_weights`` False the learned view weights.
        """
        overrides = (*self.overrides["test"], *overrides)
        config = self.composed("test", data, *overrides)
        pairs = model.config["model"]["problem"].get("frames")
        unused = ("ckpt", *(("baselines", "view_weights") if pairs else ("camera_baselines",)))
        config = {key: value for key, value in config.items() if key not in unused}
        left_out = {
            "baselines": not baselines,
            "camera_baselines": not baselines,
            "view_weights": not view_weights,
        }
        config |= {key: {} for key, out in left_out.items() if out and key in config}
        dependencies = {"model": model, "data": self.prepared(data, config["data"]["evaluate"])}
        trained = model.name.removeprefix("train-").removesuffix(f"-seed{self.seed}")
        name = "-".join(filter(None, ["test", trained, "on", data, name, f"seed{self.seed}"]))
        checkpoint = f"ckpt={_output(model.name).removeprefix('output=')}/last.ckpt"
        command = " ".join(
            ["python test.py", checkpoint, *self.words(data), *overrides, _output(name)]
        )
        seconds = seconds or SECONDS.get(data, 13.0)
        return Task(
            name, "ghpt.paper.engine.testing.measure_model", config, dependencies, command, seconds
        )


def _output(name: str) -> str:
    """Where a command that one types puts the run."""
    return f"output=runs/{name}"


def _of_source(data: Mapping[str, Any]) -> dict[str, Any]:
    """The data settings that do not change the recordings set to one value, so that seeds share
    them.
    """
    return dict(data) | {"seed": 0, "evaluate": "test", "stride": 64}


@functools.cache
def _files(conf: Path, words: tuple[str, ...]) -> dict[str, Any]:
    """The key of each split: it changes when a file of the real data set does."""
    data = build(compose(conf, "test", words)["data"], "data")
    return {split: data.cache_key(split) for split in ("train", "validation", "test")}
