"""Pairs of cameras as a torch data set: M random frames of a rig, seen by two of its cameras
(paper, section 3.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.utils.data import Dataset

from ghpt import randomness
from ghpt.errors import GhptDataError, check
from ghpt.geometry.cameras import Cameras
from ghpt.observations import (
    Labelled,
    LabelledRecording,
    PairObservations,
    PairTruth,
    select_views,
)

_VOLUME_FRAMES = 2000
"""Frames of a rig, evenly in time, whose true joints span its capture volume."""


@dataclass(frozen=True)
class PairSettings:
    """What a batch of pairs is made of."""

    frames: int
    """M, the frames of an item."""
    draws: int
    """Draws of M frames for each rig, of which every pair is tested."""
    points: int
    """P, the random points of the capture volume on which errors are measured."""

    def __post_init__(self) -> None:
        for name in ("frames", "draws", "points"):
            check(getattr(self, name) >= 1, name, f"is {getattr(self, name)}", "It must be >= 1.")


@dataclass(frozen=True)
class RigOfSplit:
    """A rig with all recordings that it made."""

    name: str
    """The subject where the rig has one, as in Human3.6M, else the names of all."""
    names: tuple[str, ...]
    cameras: Cameras
    """K, R, t with leading dimension V, float64, mm."""
    recordings: tuple[int, ...]
    points: Float[Tensor, "P 3"]
    """X*: uniform in the box of the true joints, world, mm."""


class Pairs(Dataset[Labelled[PairObservations, PairTruth]]):
    """Every pair of views of every rig with ``draws`` draws of M frames each, or ``samples`` random
    ones.

    In order: sample i is a rig, then a draw, then a pair, so that the pairs of one draw, which
    share their frames, follow one another. With ``samples`` each sample has its own draw and a
    random rig and pair. A rig with fewer than M frames fills up with frames in which nothing is
    seen. All is a pure function of the recordings, settings and seed.
    """

    def __init__(
        self,
        recordings: Sequence[LabelledRecording],
        settings: PairSettings,
        seed: int,
        samples: int | None = None,
    ) -> None:
        self.recordings = recordings
        self.settings = settings
        self.seed = seed
        self.samples = samples
        self.rigs = _rigs(recordings, settings.points, seed)
        self.pairs = list(combinations(range(len(self.rigs[0].names)), 2))

    @property
    def frames_per_item(self) -> int:
        return self.settings.frames

    @property
    def draws(self) -> int:
        return self.settings.draws

    def __len__(self) -> int:
        return (
            len(self.rigs) * self.draws * len(self.pairs) if self.samples is None else self.samples
        )

    def locate(self, sample: int) -> tuple[int, int, tuple[int, int]]:
        """The rig's index, the number of the draw over all rigs, and the pair of views."""
        if self.samples is None:
            draw, pair = divmod(sample, len(self.pairs))
            return draw // self.draws, draw, self.pairs[pair]
        rig, pair = (randomness.uniform(randomness.key(self.seed, "pair", sample), (2,))).tolist()
        return int(rig * len(self.rigs)), sample, self.pairs[int(pair * len(self.pairs))]

    def frames_of(self, rig: int, draw: int) -> list[tuple[int, Int[np.ndarray, " F"]]]:
        """The frames of a draw: recording and positions in it, in order of time; at most M."""
        recordings = self.rigs[rig].recordings
        start = np.cumsum([0] + [len(self.recordings[r]) for r in recordings])
        count = min(self.settings.frames, int(start[-1]))
        chosen = _distinct(self.seed, draw, int(start[-1]), count)
        which = np.searchsorted(start, chosen, side="right") - 1
        return [
            (r, chosen[which == i] - start[i])
            for i, r in enumerate(recordings)
            if (which == i).any()
        ]

    def __getitem__(self, samples: Sequence[int]) -> Labelled[PairObservations, PairTruth]:
        places = [self.locate(sample) for sample in samples]
        rig = torch.tensor([place[0] for place in places], dtype=torch.int64)
        drawn: dict[int, dict[str, np.ndarray]] = {}
        for which, draw, _ in places:
            if draw not in drawn:
                drawn[draw] = self._read(which, draw)
        like = self.recordings[0].key_points.shape[1:]

        def gather(field: str) -> Tensor:
            if not places:
                return torch.from_numpy(_EMPTY[field](0, like[0], self.settings.frames, like[1]))
            return torch.from_numpy(np.stack([drawn[draw][field] for _, draw, _ in places]))

        pair = torch.tensor([place[2] for place in places], dtype=torch.int64).reshape(-1, 2)
        K, R, t = (torch.stack([getattr(r.cameras, n) for r in self.rigs])[rig] for n in "KRt")
        cameras = Cameras(*(select_views(values, pair) for values in (K, R, t)))
        observations = PairObservations(
            index=torch.tensor(list(samples), dtype=torch.int64),
            rig=rig,
            draw=torch.tensor([place[1] for place in places], dtype=torch.int64),
            pair=pair,
            K=K,
            baseline=(cameras.centre[:, 1] - cameras.centre[:, 0]).norm(dim=-1),
            key_points=gather("key_points"),
            confidence=gather("confidence"),
            valid=gather("valid"),
        )
        points = torch.stack([r.points for r in self.rigs])[rig]
        return Labelled(observations, PairTruth(cameras, points))

    def _read(self, rig: int, draw: int) -> dict[str, np.ndarray]:
        """Key points, confidence and masks [V, M, J, ...] of a draw."""
        views, joints = self.recordings[0].key_points.shape[1:3]
        arrays = {
            field: make(views, self.settings.frames, joints) for field, make in _EMPTY.items()
        }
        row = 0
        for recording, positions in self.frames_of(rig, draw):
            for field, array in arrays.items():
                values = getattr(self.recordings[recording], field)[positions]
                array[:, row : row + len(positions)] = values.swapaxes(0, 1)
            row += len(positions)
        return arrays


_EMPTY = {
    "key_points": lambda *shape: np.zeros((*shape, 2), dtype=np.float32),
    "confidence": lambda *shape: np.zeros(shape, dtype=np.float32),
    "valid": lambda *shape: np.zeros(shape, dtype=bool),
}


def _distinct(seed: int, draw: int, total: int, count: int) -> Int[np.ndarray, " F"]:
    """``count`` distinct numbers below ``total``, sorted (Floyd's algorithm, so that long
    recordings cost nothing).
    """
    draws = randomness.uniform(randomness.key(seed, "frames of a draw", draw), (count,)).numpy()
    chosen: set[int] = set()
    for last, u in zip(range(total - count, total), draws, strict=True):
        candidate = int(u * (last + 1))
        chosen.add(last if candidate in chosen else candidate)
    return np.array(sorted(chosen), dtype=np.int64)


def _rigs(recordings: Sequence[LabelledRecording], points: int, seed: int) -> list[RigOfSplit]:
    """Recordings with the same cameras are of one rig."""
    groups: dict[tuple[tuple[str, ...], bytes], list[int]] = {}
    for index, recording in enumerate(recordings):
        c = recording.cameras
        values = torch.cat([c.K.flatten(1), c.R.flatten(1), c.t], dim=1).double()
        groups.setdefault((recording.camera_names, values.numpy().tobytes()), []).append(index)
    rigs = []
    for number, ((names, _), members) in enumerate(groups.items()):
        subjects = dict.fromkeys(recordings[i].subject for i in members)
        volume = _volume([recordings[i] for i in members])
        share = randomness.uniform(
            randomness.key(seed, "points of the volume", number), (points, 3)
        )
        cameras = Cameras(
            *(getattr(recordings[members[0]].cameras, n).double() for n in ("K", "R", "t"))
        )
        low, high = volume
        rigs.append(
            RigOfSplit(
                " ".join(subjects), names, cameras, tuple(members), low + share * (high - low)
            )
        )
    return rigs


def _volume(
    recordings: Sequence[LabelledRecording],
) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
    """The lowest and highest corner of the box of the true joints. Raises GhptDataError where there
    are none.
    """
    step = max(1, sum(map(len, recordings)) // _VOLUME_FRAMES)
    joints = np.concatenate([r.truth[::step][r.truth_valid[::step]] for r in recordings]).astype(
        np.float64
    )
    if not len(joints):
        raise GhptDataError(
            recordings[0].name,
            "truth",
            "has no true pose, so errors cannot be measured",
            "Use calibrate.py for it.",
        )
    return torch.from_numpy(joints.min(axis=0)), torch.from_numpy(joints.max(axis=0))
