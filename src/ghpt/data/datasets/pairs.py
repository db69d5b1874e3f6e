"""Pairs of cameras as a torch data set (paper, section 3.2).

A sample is M random frames of a rig, seen by two of its cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
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


class Place(NamedTuple):
    """What a sample is of."""

    rig: int
    """Index among the rigs."""
    draw: int
    """Number of the draw of frames, over all rigs."""
    pair: tuple[int, int]
    """The two views."""


class Pairs(Dataset[Labelled[PairObservations, PairTruth]]):
    """Every pair of views of every rig, with ``draws`` draws of M frames each, or random ones.

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
    def draws(self) -> int:
        """Draws of each rig."""
        return self.settings.draws

    def __len__(self) -> int:
        if self.samples is not None:
            return self.samples
        return len(self.rigs) * self.draws * len(self.pairs)

    def locate(self, sample: int) -> Place:
        """Return what a sample is of."""
        if self.samples is None:
            draw, pair = divmod(sample, len(self.pairs))
            return Place(draw // self.draws, draw, self.pairs[pair])
        key = randomness.key(self.seed, "pair", sample)
        for_rig, for_pair = randomness.uniform(key, (2,)).tolist()
        rig = int(for_rig * len(self.rigs))
        pair = int(for_pair * len(self.pairs))
        return Place(rig, sample, self.pairs[pair])

    def locate_frames(self, rig: int, draw: int) -> list[tuple[int, Int[np.ndarray, " F"]]]:
        """Return the frames of a draw: recording and positions in it, in order of time.

        There are at most M of them.
        """
        recordings = self.rigs[rig].recordings
        start = np.cumsum([0, *(len(self.recordings[index]) for index in recordings)])
        total = int(start[-1])
        chosen = _distinct(self.seed, draw, total, min(self.settings.frames, total))
        which = np.searchsorted(start, chosen, side="right") - 1
        frames = []
        for place, recording in enumerate(recordings):
            positions = chosen[which == place] - start[place]
            if len(positions):
                frames.append((recording, positions))
        return frames

    def __getitem__(self, samples: Sequence[int]) -> Labelled[PairObservations, PairTruth]:
        places = [self.locate(sample) for sample in samples]
        rig = torch.tensor([place.rig for place in places], dtype=torch.int64)
        draw = torch.tensor([place.draw for place in places], dtype=torch.int64)
        pair = torch.tensor([place.pair for place in places], dtype=torch.int64).reshape(-1, 2)
        K = torch.stack([r.cameras.K for r in self.rigs])[rig]
        R = torch.stack([r.cameras.R for r in self.rigs])[rig]
        t = torch.stack([r.cameras.t for r in self.rigs])[rig]
        cameras = Cameras(select_views(K, pair), select_views(R, pair), select_views(t, pair))
        seen = self._gather(places)
        observations = PairObservations(
            index=torch.tensor(list(samples), dtype=torch.int64),
            rig=rig,
            draw=draw,
            pair=pair,
            K=K,
            baseline=(cameras.centre[:, 1] - cameras.centre[:, 0]).norm(dim=-1),
            key_points=torch.from_numpy(seen.key_points),
            confidence=torch.from_numpy(seen.confidence),
            valid=torch.from_numpy(seen.valid),
        )
        points = torch.stack([r.points for r in self.rigs])[rig]
        return Labelled(observations, PairTruth(cameras, points))

    def _gather(self, places: Sequence[Place]) -> _Seen:
        """Return what all views see at these places; the pairs of one draw are read once."""
        if not places:
            views, joints = self.recordings[0].key_points.shape[1:3]
            return _Seen.empty(0, views, self.settings.frames, joints)
        drawn: dict[int, _Seen] = {}
        for place in places:
            if place.draw not in drawn:
                drawn[place.draw] = self._read(place.rig, place.draw)
        each = [drawn[place.draw] for place in places]
        return _Seen(
            key_points=np.stack([seen.key_points for seen in each]),
            confidence=np.stack([seen.confidence for seen in each]),
            valid=np.stack([seen.valid for seen in each]),
        )

    def _read(self, rig: int, draw: int) -> _Seen:
        """Return what the V views see in the M frames of a draw."""
        views, joints = self.recordings[0].key_points.shape[1:3]
        seen = _Seen.empty(views, self.settings.frames, joints)
        row = 0
        for index, positions in self.locate_frames(rig, draw):
            recording = self.recordings[index]
            rows = slice(row, row + len(positions))
            seen.key_points[:, rows] = recording.key_points[positions].swapaxes(0, 1)
            seen.confidence[:, rows] = recording.confidence[positions].swapaxes(0, 1)
            seen.valid[:, rows] = recording.valid[positions].swapaxes(0, 1)
            row += len(positions)
        return seen


@dataclass(frozen=True)
class _Seen:
    """What V views see in M frames, with any leading dimensions."""

    key_points: Float[np.ndarray, "*B V M J 2"]
    confidence: Float[np.ndarray, "*B V M J"]
    valid: Bool[np.ndarray, "*B V M J"]

    @staticmethod
    def empty(*shape: int) -> _Seen:
        """Return what views see that see nothing."""
        key_points = np.zeros((*shape, 2), dtype=np.float32)
        confidence = np.zeros(shape, dtype=np.float32)
        return _Seen(key_points, confidence, np.zeros(shape, dtype=bool))


def _distinct(seed: int, draw: int, total: int, count: int) -> Int[np.ndarray, " F"]:
    """Return ``count`` distinct numbers below ``total``, sorted.

    Floyd's algorithm, so that long recordings cost nothing.
    """
    draws = randomness.uniform(randomness.key(seed, "frames of a draw", draw), (count,)).numpy()
    chosen: set[int] = set()
    for last, uniform in zip(range(total - count, total), draws, strict=True):
        candidate = int(uniform * (last + 1))
        chosen.add(last if candidate in chosen else candidate)
    return np.array(sorted(chosen), dtype=np.int64)


def _rigs(recordings: Sequence[LabelledRecording], points: int, seed: int) -> list[RigOfSplit]:
    """Return the rigs: recordings with the same cameras are of one."""
    groups: dict[tuple[tuple[str, ...], bytes], list[int]] = {}
    for index, recording in enumerate(recordings):
        K = recording.cameras.K.flatten(1)
        R = recording.cameras.R.flatten(1)
        values = torch.cat([K, R, recording.cameras.t], dim=1).double()
        identity = (recording.camera_names, values.numpy().tobytes())
        groups.setdefault(identity, []).append(index)
    rigs = []
    for number, ((names, _), members) in enumerate(groups.items()):
        own = [recordings[index] for index in members]
        subjects = dict.fromkeys(recording.subject for recording in own)
        low, high = _volume(own)
        key = randomness.key(seed, "points of the volume", number)
        share = randomness.uniform(key, (points, 3))
        rigs.append(
            RigOfSplit(
                name=" ".join(subjects),
                names=names,
                cameras=own[0].cameras.to(torch.float64),
                recordings=tuple(members),
                points=low + share * (high - low),
            )
        )
    return rigs


def _volume(
    recordings: Sequence[LabelledRecording],
) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
    """Return the lowest and highest corner of the box of the true joints.

    Raises GhptDataError where there are none.
    """
    step = max(1, sum(map(len, recordings)) // _VOLUME_FRAMES)
    parts = [r.truth[::step][r.truth_valid[::step]] for r in recordings]
    joints = np.concatenate(parts).astype(np.float64)
    if not len(joints):
        problem = "has no true pose, so errors cannot be measured"
        raise GhptDataError(recordings[0].name, "truth", problem, "Use calibrate.py for it.")
    return torch.from_numpy(joints.min(axis=0)), torch.from_numpy(joints.max(axis=0))
