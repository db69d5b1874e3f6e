"""Frames as a torch data set, and the order in which training sees them."""

from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch.utils.data import DataLoader, Dataset, SequentialSampler

from ghpt import randomness
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import Cameras
from ghpt.observations import (
    Labelled,
    LabelledRecording,
    Observations,
    Truth,
    joints_with_enough_views,
)
from ghpt.skeleton import PELVIS


@runtime_checkable
class SampleSet(Protocol):
    """What is trained or tested on: a data set whose items are whole batches."""

    def __len__(self) -> int:
        """Return the number of samples."""

    def __getitem__(self, samples: Sequence[int]) -> Labelled[Any, Any]:
        """Return the batch of these samples."""


@dataclass(frozen=True)
class Sampling:
    """Which samples of a split are drawn."""

    source: str
    """Where the recordings are from, for errors."""
    split: str
    """Data set and split, for errors."""
    seed: int
    """Of the random choice."""
    train_samples: int | None
    """How many to draw for training; None: all, for validation and tests."""
    stride: int
    """Of validation and tests: every ``stride``-th frame of a recording."""
    least_joints: int
    """Joints, both true and triangulable, that a frame needs to teach anything."""


class Frames(Dataset[Labelled[Observations, Truth]]):
    """Chosen frames of recordings that share a number of views; one item is a whole batch.

    ``frames`` are positions in the recordings laid end to end, in any order; sample i is
    ``frames[i]``.
    """

    def __init__(
        self, recordings: Sequence[LabelledRecording], frames: Int[np.ndarray, " N"]
    ) -> None:
        self.recordings = recordings
        self.frames = np.asarray(frames, dtype=np.int64)
        self.start = _starts(recordings)
        rigs = [recording.cameras.to(torch.float64) for recording in recordings]
        K = torch.stack([rig.K for rig in rigs])
        R = torch.stack([rig.R for rig in rigs])
        self.cameras = Cameras(K, R, torch.stack([rig.t for rig in rigs]))

    def __len__(self) -> int:
        return len(self.frames)

    def locate(self, sample: int) -> tuple[int, int]:
        """Return the recording's index and the frame's position in it."""
        recording = bisect_right(self.start, self.frames[sample]) - 1
        return recording, int(self.frames[sample] - self.start[recording])

    def __getitem__(self, samples: Sequence[int]) -> Labelled[Observations, Truth]:
        places = [self.locate(sample) for sample in samples]
        recording = torch.tensor([index for index, _ in places], dtype=torch.int64)
        observations = Observations(
            index=torch.tensor(list(samples), dtype=torch.int64),
            recording=recording,
            cameras=self.cameras.index(recording),
            key_points=self._gather("key_points", places),
            confidence=self._gather("confidence", places),
            valid=self._gather("valid", places),
        )
        truth = Truth(self._gather("truth", places), self._gather("truth_valid", places))
        return Labelled(observations, truth)

    def _gather(self, field: str, places: Sequence[tuple[int, int]]) -> torch.Tensor:
        """Return the values of a recording's array at these places."""
        like: np.ndarray = getattr(self.recordings[0], field)
        rows = np.empty((len(places), *like.shape[1:]), dtype=like.dtype)
        for row, (recording, position) in enumerate(places):
            rows[row] = getattr(self.recordings[recording], field)[position]
        return torch.from_numpy(rows)

    def frame_numbers(self, samples: Sequence[int]) -> Int[np.ndarray, " B"]:
        """Return the data set's own frame numbers."""
        places = map(self.locate, samples)
        numbers = [self.recordings[recording].frame[position] for recording, position in places]
        return np.array(numbers, dtype=np.int64)


def draw_frames(recordings: Sequence[LabelledRecording], sampling: Sampling) -> Frames:
    """Return random frames that can teach for training, evenly spaced ones for the rest.

    Raises GhptDataError where no frame can teach.
    """
    if sampling.train_samples is None:
        return Frames(recordings, _every(recordings, sampling.stride))
    return Frames(recordings, _random(recordings, sampling, sampling.train_samples))


def trainable(
    recordings: Sequence[LabelledRecording], frames: Int[np.ndarray, " N"], joints: int
) -> Bool[np.ndarray, " N"]:
    """Return which frames can teach.

    They have a true pelvis, and at least ``joints`` joints that are both true and triangulable.
    """
    batch = Frames(recordings, frames)[range(len(frames))]
    learnable = joints_with_enough_views(batch.observations.valid) & batch.truth.valid
    return (learnable[:, PELVIS] & (learnable.sum(dim=1) >= joints)).numpy()


def _starts(recordings: Sequence[LabelledRecording]) -> Int[np.ndarray, " S"]:
    """Return where each recording begins among all frames, and where the last one ends."""
    return np.cumsum([0, *map(len, recordings)])


def _every(recordings: Sequence[LabelledRecording], stride: int) -> Int[np.ndarray, " N"]:
    """Return every ``stride``-th frame of each recording."""
    starts = _starts(recordings)
    return np.concatenate([np.arange(a, b, stride) for a, b in pairwise(starts)])


def _random(
    recordings: Sequence[LabelledRecording], sampling: Sampling, count: int
) -> Int[np.ndarray, " N"]:
    """Return ``count`` random frames that can teach, or all where there are fewer."""
    total = int(_starts(recordings)[-1])
    order = randomness.permutation(sampling.seed, "training samples", 0, total).numpy()
    chosen = np.empty(0, dtype=np.int64)
    for first in range(0, total, 4 * count):
        some = order[first : first + 4 * count]
        teaches = trainable(recordings, some, sampling.least_joints)
        chosen = np.concatenate([chosen, some[teaches]])
        if len(chosen) >= count:
            break
    if not len(chosen):
        joints = f"{sampling.least_joints} joints seen in two views"
        raise GhptDataError(
            sampling.source,
            sampling.split,
            f"no frame has a true pelvis and {joints}",
            "Lower data.least_joints, or check the detections.",
        )
    return chosen[:count]


class BatchOrder(SequentialSampler):
    """The samples of each batch for one process.

    To Lightning, which puts a sampler of its own in the place of others when it overfits, it is
    sequential.

    The order is a pure function of the seed (None: as the samples are) and the batches already
    done. A global batch is ``batch_size`` samples in the same order on any number of processes;
    process ``rank`` takes every ``world``-th of them, so its share of the last one can be empty.
    ``done()`` says how many global batches training has finished, over all epochs, so that a
    resumed run goes on where it was stopped.
    """

    def __init__(
        self,
        count: int,
        batch_size: int,
        rank: int,
        world: int,
        seed: int | None,
        done: Callable[[], int],
    ) -> None:
        self.count = count
        self.batch_size = batch_size
        self.rank = rank
        self.world = world
        self.seed = seed
        self.done = done

    def __len__(self) -> int:
        return -(-self.count // self.batch_size)

    def __iter__(self) -> Iterator[list[int]]:  # type: ignore[override]  # of batches
        epoch, first = divmod(self.done(), len(self))
        order = torch.arange(self.count)
        if self.seed is not None:
            order = randomness.permutation(self.seed, "order", epoch, self.count)
        for batch in range(first, len(self)):
            start = batch * self.batch_size
            together = order[start : start + self.batch_size]
            yield together[self.rank :: self.world].tolist()


class FrameLoader(DataLoader[Any]):
    """Loads batches in a ``BatchOrder``.

    It has no state to save, since the order knows where to go on.
    """

    def __init__(self, samples: Any, order: BatchOrder, workers: int) -> None:
        pin = torch.cuda.is_available()
        super().__init__(
            samples, sampler=order, batch_size=None, num_workers=workers, pin_memory=pin
        )

    def state_dict(self) -> dict[str, Any]:
        """Return nothing; the method tells Lightning that a run can be resumed within an epoch."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Do nothing: ``BatchOrder.done`` knows the place."""
