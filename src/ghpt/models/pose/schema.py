"""What predictions.npz of the pose problem holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Int
from torch import Tensor

from ghpt.models.predictions import (
    TRUE_JOINTS,
    Chunk,
    InvalidArray,
    Predictions,
    Record,
    Schema,
    Tables,
    TrueJoints,
)
from ghpt.observations import PoseEstimate, Recording
from ghpt.skeleton import JOINTS


@dataclass(frozen=True)
class PoseSample(TrueJoints):
    """A frame's true pose, and where it is from."""

    recording: Int[Tensor, " B"]
    """Index of the recording in the tables."""
    frame: Int[Tensor, " B"]
    """The data set's own frame number."""


@dataclass(frozen=True)
class PoseTables(Tables):
    """The recordings of a test run, and the joints' names."""

    dtypes: ClassVar = dict.fromkeys(
        ("recording_name", "recording_subject", "recording_action", "joint_name"), "U"
    )

    recording_name: np.ndarray
    recording_subject: np.ndarray
    recording_action: np.ndarray
    joint_name: np.ndarray

    @staticmethod
    def from_recordings(recordings: Sequence[Recording]) -> PoseTables:
        """Return the tables of these recordings."""
        return PoseTables(
            recording_name=np.array([r.name for r in recordings], np.str_),
            recording_subject=np.array([r.subject for r in recordings], np.str_),
            recording_action=np.array([r.action for r in recordings], np.str_),
            joint_name=np.array(JOINTS),
        )

    def check(self) -> None:
        """Raise InvalidArray unless every recording has all names, and the joints are ghpt's."""
        if self.joint_name.tolist() != list(JOINTS):
            raise InvalidArray("joint_name", "is not the 17 joints in ghpt's order")
        shapes = {self.recording_subject.shape, self.recording_action.shape}
        if shapes != {(len(self.recording_name.ravel()),)}:
            raise InvalidArray("recording_name", "subjects and actions are not as many")

    def check_sample(self, sample: PoseSample) -> None:
        """Raise InvalidArray if a frame is of no recording."""
        recording = sample.recording
        if ((recording < 0) | (recording >= len(self.recording_name))).any():
            raise InvalidArray("recording", "names a recording that is not listed")


_ESTIMATE = {"points": ("<f4", (len(JOINTS), 3)), "estimated": ("|b1", (len(JOINTS),))}
_SAMPLE = TRUE_JOINTS.columns | {"recording": ("<i4", ()), "frame": ("<i8", ())}

POSES = Schema("pose", Record(PoseEstimate, _ESTIMATE), Record(PoseSample, _SAMPLE), PoseTables)
PosePredictions = Predictions[PoseEstimate, PoseSample, PoseTables]
PoseChunk = Chunk[PoseEstimate, PoseSample]
