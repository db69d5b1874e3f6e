"""Random recordings as a DataModule: what the models of single key points learn from."""

from collections.abc import Iterable, Mapping
from typing import Any, TypedDict

from ghpt.data.datasets.arrangements import synthesis_digest
from ghpt.data.datasets.datamodule import SPLITS, KeyPointDataModule
from ghpt.data.synthetic.random_recordings import random_recordings
from ghpt.errors import GhptConfigError, check
from ghpt.observations import LabelledRecording


class RandomSettings(TypedDict):
    """Settings of the random recordings."""

    seed: int
    recordings: Mapping[str, int]
    """How many each split has."""
    frames: int
    """Of each recording."""


class RandomRecordings(KeyPointDataModule):
    """Recordings of random people before random rigs by random detectors; all synthetic."""

    def __init__(self, synthetic: RandomSettings, **settings: Any) -> None:
        super().__init__(**settings)
        if self.root is not None:
            problem = "is given, but random recordings are synthetic"
            raise GhptConfigError("data.root", problem, "Leave it out, or name another data set.")
        frames = synthetic["frames"]
        check(frames >= 1, "data.synthetic.frames", f"is {frames}", "It must be >= 1.")
        for split in SPLITS:
            count = synthetic["recordings"][split]
            key = f"data.synthetic.recordings.{split}"
            check(count >= 1, key, f"is {count}", "It must be >= 1.")
        self.synthetic = synthetic

    def generate(self, split: str) -> Iterable[LabelledRecording]:
        settings = self.synthetic
        count = settings["recordings"][split]
        return random_recordings(split, settings["seed"], count, settings["frames"])

    def cache_key(self, split: str) -> dict[str, Any]:
        settings = self.synthetic
        return {
            "name": f"{self.name}-{split}",
            "recordings": settings["recordings"][split],
            "frames": settings["frames"],
            "seed": settings["seed"],
            "made by": synthesis_digest(),
        }
