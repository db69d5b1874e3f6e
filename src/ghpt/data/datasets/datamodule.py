"""DataModules of the 2D key points of a camera arrangement, synthetic or real (``root``)."""

from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import lightning as L

from ghpt.data.datasets.frames import (
    BatchOrder,
    FrameLoader,
    SampleSet,
    Sampling,
    draw_frames,
)
from ghpt.data.datasets.store import prepare
from ghpt.errors import GhptDataError, check
from ghpt.observations import Labelled, LabelledRecording

SPLITS = ("train", "validation", "test")

Draw = Callable[[Sequence[LabelledRecording], Sampling], SampleSet]
"""Draws the samples of a split from its recordings."""


class KeyPointDataModule(L.LightningDataModule):
    """What all arrangements share: preparation, choice of samples, batches.

    ``root`` None means the synthetic source, a path the real data set there. ``seed`` chooses the
    training samples and their order. ``batch_size`` is the global one, divided among the processes.
    ``evaluate`` names the split that ``test`` runs on.
    """

    def __init__(
        self,
        name: str,
        root: str | None,
        cache: str | None,
        seed: int,
        train_samples: int,
        least_joints: int,
        stride: int,
        evaluate: str,
        batch_size: int,
        workers: int,
    ) -> None:
        super().__init__()
        counts = {"train_samples": train_samples, "stride": stride, "batch_size": batch_size}
        for key, value in counts.items():
            check(value >= 1, f"data.{key}", f"is {value}", "It must be >= 1.")
        check(workers >= 0, "data.workers", f"is {workers}", "It must be >= 0.")
        possible = 1 <= least_joints <= 17
        check(possible, "data.least_joints", f"is {least_joints}", "It must be 1 to 17.")
        hint = f"Existing: {', '.join(SPLITS)}."
        check(evaluate in SPLITS, "data.evaluate", f"is {evaluate!r}", hint)
        self.name = name
        self.root = root
        self.cache = cache
        self.seed = seed
        self.train_samples = train_samples
        self.least_joints = least_joints
        self.stride = stride
        self.evaluate = evaluate
        self.batch_size = batch_size
        self.workers = workers
        self.draw: Draw = draw_frames
        self.frames: dict[str, SampleSet] = {}
        """The samples of each role: train, validation, test."""

    def bind(self, problem: Any) -> None:
        """Take the samples that a problem draws from recordings, in place of frames."""
        self.draw = problem.dataset

    @property
    def source(self) -> str:
        """``synthetic`` or the path of the real data."""
        return "synthetic" if self.root is None else str(Path(self.root).resolve())

    @abstractmethod
    def generate(self, split: str) -> Iterable[LabelledRecording]:
        """Return the split's recordings from their source, slowly."""

    @abstractmethod
    def cache_key(self, split: str) -> dict[str, Any]:
        """Return everything that decides what ``generate`` gives, as plain data."""

    def prepare_data(self) -> None:
        """Prepare what is not yet in the cache (one process; the others then open it)."""
        stage = "test" if self.trainer and self.trainer.state.fn == "test" else "fit"
        for split in self._roles(stage).values():
            self.recordings(split)

    def setup(self, stage: str) -> None:
        for role, split in self._roles(stage).items():
            if role not in self.frames:
                self.frames[role] = self.draw(self.recordings(split), self._sampling(role))

    def _sampling(self, role: str) -> Sampling:
        return Sampling(
            source=self.source,
            split=f"{self.name} {role}",
            seed=self.seed,
            train_samples=self.train_samples if role == "train" else None,
            stride=self.stride,
            least_joints=self.least_joints,
        )

    def _roles(self, stage: str) -> dict[str, str]:
        """Return the split of each role that the stage needs."""
        if stage == "test":
            return {"test": self.evaluate}
        return {"train": "train", "validation": "validation"}

    def recordings(self, split: str) -> list[LabelledRecording]:
        """Return the split's recordings, prepared first where they are not in the cache.

        Raises GhptDataError where there are none.
        """
        about = {"source": self.source, "split": split}
        key = self.cache_key(split)
        recordings = prepare(self.cache, key, lambda: self.generate(split), about)
        if not sum(map(len, recordings)):
            where = f"{self.name} {split}"
            hint = "Choose another split, or check what data.root holds."
            raise GhptDataError(self.source, where, "the split has no frames", hint)
        return recordings

    def train_dataloader(self) -> FrameLoader:
        if getattr(self.trainer, "overfit_batches", 0) > 0:
            return self._loader("train")  # the first batches, in every epoch
        return self._loader("train", seed=self.seed, done=self._batches_done)

    def _batches_done(self) -> int:
        return self.trainer.global_step if self.trainer else 0

    def val_dataloader(self) -> FrameLoader:
        return self._loader("validation")

    def test_dataloader(self) -> FrameLoader:
        return self._loader("test")

    def _loader(
        self, role: str, seed: int | None = None, done: Callable[[], int] = lambda: 0
    ) -> FrameLoader:
        rank = self.trainer.global_rank if self.trainer else 0
        world = self.trainer.world_size if self.trainer else 1
        order = BatchOrder(len(self.frames[role]), self.batch_size, rank, world, seed, done)
        return FrameLoader(self.frames[role], order, self.workers)

    def all_training_batches(self) -> Iterator[Labelled[Any, Any]]:
        """Yield every training sample once, in order, the same on every process."""
        frames = self.frames["train"]
        for first in range(0, len(frames), self.batch_size):
            yield frames[range(first, min(first + self.batch_size, len(frames)))]
