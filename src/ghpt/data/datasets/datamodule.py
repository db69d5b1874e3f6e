"""DataModules that serve the 2D key points of a camera arrangement, synthetic or real (``root``)."""

from abc import abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np

from ghpt import randomness
from ghpt.data.datasets.frames import BatchOrder, FrameLoader, Frames, trainable
from ghpt.data.datasets.pairs import Pairs, PairSettings
from ghpt.data.datasets.store import prepared
from ghpt.errors import GhptDataError, check
from ghpt.observations import Labelled, LabelledRecording

SPLITS = ("train", "validation", "test")


class KeyPointDataModule(L.LightningDataModule):
    """Shared by all arrangements: preparation, choice of frames, batches.

    ``root`` None means the synthetic source, a path the real data set there. ``seed``
    chooses the training samples and their order. ``batch_size`` is the global one, divided among
    the processes. ``evaluate`` names the split that ``test`` runs on.
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
        for key, value in (
            ("train_samples", train_samples),
            ("stride", stride),
            ("batch_size", batch_size),
        ):
            check(value >= 1, f"data.{key}", f"is {value}", "It must be >= 1.")
        check(workers >= 0, "data.workers", f"is {workers}", "It must be >= 0.")
        check(
            1 <= least_joints <= 17,
            "data.least_joints",
            f"is {least_joints}",
            "It must be 1 to 17.",
        )
        check(
            evaluate in SPLITS,
            "data.evaluate",
            f"is {evaluate!r}",
            f"Existing: {', '.join(SPLITS)}.",
        )
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
        self.pairs: PairSettings | None = None
        self.frames: dict[str, Frames | Pairs] = {}

    def bind(self, problem: Any) -> None:
        """Serve what ``problem`` takes: pairs of cameras where it has ``PairSettings`` (``pairs``),
        else frames.
        """
        self.pairs = getattr(problem, "pairs", None)

    @property
    def source(self) -> str:
        """``synthetic`` or the path of the real data."""
        return "synthetic" if self.root is None else str(Path(self.root).resolve())

    @abstractmethod
    def generate(self, split: str) -> Iterable[LabelledRecording]:
        """The split's recordings from their source, slowly."""

    @abstractmethod
    def cache_key(self, split: str) -> dict[str, Any]:
        """Everything that decides what ``make`` gives, as plain data."""

    def prepare_data(self) -> None:
        """Prepare what is not yet in the cache (one process; the others then open it)."""
        stage = "test" if self.trainer and self.trainer.state.fn == "test" else "fit"
        for split in self._roles(stage).values():
            self.recordings(split)

    def setup(self, stage: str) -> None:
        for role, split in self._roles(stage).items():
            if role not in self.frames:
                self.frames[role] = self._choose(self.recordings(split), role == "train")

    def _roles(self, stage: str) -> dict[str, str]:
        """What the stage needs: role -> split."""
        return (
            {"test": self.evaluate}
            if stage == "test"
            else {"train": "train", "validation": "validation"}
        )

    def recordings(self, split: str) -> list[LabelledRecording]:
        """The split's recordings, prepared first where they are not in the cache. Raises
        GhptDataError.
        """
        recordings = prepared(
            self.cache,
            self.cache_key(split),
            lambda: self.generate(split),
            {"source": self.source, "split": split},
        )
        if not sum(map(len, recordings)):
            hint = "Choose another split, or check what data.root holds."
            raise GhptDataError(
                self.source, f"{self.name} {split}", "the split has no frames", hint
            )
        return recordings

    def _choose(self, recordings: Sequence[LabelledRecording], training: bool) -> Frames | Pairs:
        if self.pairs is not None:
            return Pairs(
                recordings, self.pairs, self.seed, self.train_samples if training else None
            )
        return Frames(recordings, self._random(recordings) if training else self._every(recordings))

    def _every(self, recordings: Sequence[LabelledRecording]) -> np.ndarray:
        """Every ``stride``-th frame of each recording."""
        starts = np.cumsum([0] + [len(r) for r in recordings])
        return np.concatenate([np.arange(a, b, self.stride) for a, b in pairwise(starts)])

    def _random(self, recordings: Sequence[LabelledRecording]) -> np.ndarray:
        """``train_samples`` random frames that can teach."""
        order = randomness.permutation(
            self.seed, "training samples", 0, sum(map(len, recordings))
        ).numpy()
        chosen = np.empty(0, dtype=np.int64)
        for first in range(0, len(order), 4 * self.train_samples):
            some = order[first : first + 4 * self.train_samples]
            chosen = np.concatenate([chosen, some[trainable(recordings, some, self.least_joints)]])
            if len(chosen) >= self.train_samples:
                break
        if not len(chosen):
            raise GhptDataError(
                self.source,
                f"{self.name} train",
                f"no frame has a true pelvis and {self.least_joints} joints seen in two views",
                "Lower data.least_joints, or check the detections.",
            )
        return chosen[: self.train_samples]

    def train_dataloader(self) -> FrameLoader:
        return self._loader("train", seed=self.seed, done=lambda: self.trainer.global_step)

    def val_dataloader(self) -> FrameLoader:
        return self._loader("validation")

    def test_dataloader(self) -> FrameLoader:
        return self._loader("test")

    def _loader(self, role: str, seed: int | None = None, done: Any = lambda: 0) -> FrameLoader:
        rank, world = (
            (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)
        )
        order = BatchOrder(len(self.frames[role]), self.batch_size, rank, world, seed, done)
        return FrameLoader(self.frames[role], order, self.workers)

    def all_training_batches(self) -> Iterator[Labelled[Any, Any]]:
        """Every training sample once, in order, the same on every process: for the feature
        statistics.
        """
        frames = self.frames["train"]
        for first in range(0, len(frames), self.batch_size):
            yield frames[range(first, min(first + self.batch_size, len(frames)))]
