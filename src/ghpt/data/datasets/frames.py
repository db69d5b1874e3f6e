"""Frames as a torch data set, and the order in which training sees them."""

from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from ghpt import randomness
from ghpt.geometry.cameras import Cameras
from ghpt.observations import (
    Labelled,
    LabelledRecording,
    Observations,
    Truth,
    joints_with_enough_views,
)
from ghpt.skeleton import PELVIS


class Frames(Dataset[Labelled[Observations, Truth]]):
    """Chosen frames of recordings that share a number of views; one item is a whole batch.

    ``frames`` are positions in the recordings laid end to end, in any order; sample i is
    ``frames[i]``.
    """

    def __init__(self, recordings: Sequence[LabelledRecording], frames: np.ndarray) -> None:
        self.recordings = recordings
        self.frames = np.asarray(frames, dtype=np.int64)
        self.start = np.concatenate([[0], np.cumsum([len(r) for r in recordings])])
        self.cameras = Cameras(
            *(
                torch.stack([getattr(r.cameras, name).double() for r in recordings])
                for name in ("K", "R", "t")
            )
        )

    def __len__(self) -> int:
        return len(self.frames)

    def locate(self, sample: int) -> tuple[int, int]:
        """The recording's index and the frame's position in it."""
        recording = bisect_right(self.start, self.frames[sample]) - 1
        return recording, int(self.frames[sample] - self.start[recording])

    def __getitem__(self, samples: Sequence[int]) -> Labelled[Observations, Truth]:
        places = [self.locate(sample) for sample in samples]
        recording = torch.tensor([r for r, _ in places], dtype=torch.int64)

        def gather(field: str) -> torch.Tensor:
            like = getattr(self.recordings[0], field)
            rows = np.empty((len(places), *like.shape[1:]), dtype=like.dtype)
            for row, (r, t) in enumerate(places):
                rows[row] = getattr(self.recordings[r], field)[t]
            return torch.from_numpy(rows)

        observations = Observations(
            index=torch.tensor(list(samples), dtype=torch.int64),
            recording=recording,
            cameras=self.cameras.index(recording),
            key_points=gather("key_points"),
            confidence=gather("confidence"),
            valid=gather("valid"),
        )
        return Labelled(observations, Truth(gather("truth"), gather("truth_valid")))

    def frame_numbers(self, samples: Sequence[int]) -> np.ndarray:
        """The data set's own frame numbers."""
        return np.array(
            [self.recordings[r].frame[t] for r, t in map(self.locate, samples)], dtype=np.int64
        )


def trainable(
    recordings: Sequence[LabelledRecording], frames: np.ndarray, joints: int
) -> np.ndarray:
    """Which frames have a truth, with the pelvis and at least ``joints`` joints both true and
    triangulable.
    """
    data = Frames(recordings, frames)
    batch = data[range(len(frames))]
    learnable = joints_with_enough_views(batch.observations.valid) & batch.truth.valid
    return (learnable[:, PELVIS] & (learnable.sum(dim=1) >= joints)).numpy()


class BatchOrder(Sampler[list[int]]):
    """The samples of each batch for one process: a pure function of the seed and the batches
    already done.

    A global batch is ``batch_size`` samples in the same order on any number of processes; process
    ``rank`` takes every ``world``-th of them, so its share of the last one can be empty. ``done()``
    says how many global batches training has finished, over all epochs, so that a resumed run goes
    on where it was stopped.
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

    def __iter__(self) -> Iterator[list[int]]:
        epoch, first = divmod(self.done(), len(self))
        order = (
            torch.arange(self.count)
            if self.seed is None
            else randomness.permutation(self.seed, "order", epoch, self.count)
        )
        for batch in range(first, len(self)):
            yield order[batch * self.batch_size : (batch + 1) * self.batch_size][
                self.rank :: self.world
            ].tolist()


class FrameLoader(DataLoader[Any]):
    """Loads batches in a ``BatchOrder``. It has no state to save, since the order knows where to go
    on.
    """

    def __init__(self, frames: Dataset[Any], order: BatchOrder, workers: int) -> None:
        pin = torch.cuda.is_available()
        super().__init__(
            frames, sampler=order, batch_size=None, num_workers=workers, pin_memory=pin
        )

    def state_dict(self) -> dict[str, Any]:
        """Empty; its being there tells Lightning that a run can be resumed within an epoch."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Nothing to do: see ``BatchOrder.done``."""
