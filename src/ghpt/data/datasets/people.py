"""Recordings of several people as a DataModule: what `test.py data=people` runs on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NoReturn, TypedDict

import lightning as L
import torch
from torch.utils.data import DataLoader

from ghpt.config import check_arguments
from ghpt.data.synthetic.detector import Detector
from ghpt.data.synthetic.people import PeopleRecording, record_people, scene_of
from ghpt.errors import GhptConfigError, check


class Synthetic(TypedDict):
    """Settings of the synthetic source."""

    seed: int
    detector: dict[str, Any]


class People(L.LightningDataModule):
    """The scenes by name, one recording each, for testing alone."""

    source = "synthetic"

    def __init__(
        self,
        name: str,
        root: str | None,
        evaluate: str,
        synthetic: Synthetic,
        scenes: Mapping[str, Mapping[str, Any]],
    ) -> None:
        super().__init__()
        check(
            root is None, "data.root", f"is {root}", "Several people are synthetic: leave it out."
        )
        check(evaluate == "test", "data.evaluate", f"is {evaluate}", "There is test alone.")
        check(len(scenes) > 0, "data.scenes", "is empty", "Name a scene.")
        check_arguments(Detector, synthetic["detector"], "data.synthetic.detector")
        self.name = name
        self.evaluate = evaluate
        self.seed = synthetic["seed"]
        self.detector = Detector(**synthetic["detector"])
        self.scenes = {
            name: scene_of(scene, f"data.scenes.{name}") for name, scene in scenes.items()
        }

    def bind(self, problem: object) -> NoReturn:
        """Raise GhptConfigError: nothing is trained on these recordings."""
        hint = "Choose cmu2 or h36m, say."
        raise GhptConfigError("data", "people is for test.py without a checkpoint", hint)

    def recording(self, name: str) -> PeopleRecording:
        """Return the recording of a scene."""
        return record_people(name, self.scenes[name], self.detector, self.seed)

    def test_dataloader(self) -> DataLoader[PeopleRecording]:
        names = list(self.scenes)
        return DataLoader(names, batch_size=None, collate_fn=self.recording)  # type: ignore[arg-type]

    def transfer_batch_to_device(
        self, batch: PeopleRecording, device: torch.device, dataloader_idx: int
    ) -> PeopleRecording:
        """Return the recording as it is: people are told apart on the CPU."""
        return batch
