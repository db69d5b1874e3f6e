"""Which of the people whom each view follows by itself are one person: told by essential matrices,
before any extrinsics are known.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ghpt.calibration.observations import Correspondences, observe, usable
from ghpt.calibration.pairs import PairEstimation
from ghpt.data.people.sequence import KeyPointArrays, Sequence
from ghpt.data.points import KeyPoints

_FRAMES = 60
"""Of the recording, evenly spread."""
_PEOPLE = 4
"""Most people to whom a view is attached."""
_CLEARLY = 0.05
"""By how much larger the mean share of inliers must be for other tracks than the first of each
view to be taken.
"""
_AS_WELL = 0.9
"""Share of the first person's agreement that another's tracks must reach to be taken for one."""


def same_people(
    tracks: list[Sequence], pairs: PairEstimation, noise: float, seed: int
) -> list[Sequence]:
    """Return the sequences of people, each made of one track of each view, the surest first.

    ``tracks``: the k-th holds the k-th most prominent person of each view, who need not be the
    same.

    1. Of all choices the one is taken whose key points agree with an essential matrix in the
       largest mean share over all pairs of views; the first of each view, unless others are clearly
       better.
    2. The next person is the best choice of the other tracks, as long as they agree about as well.
    """
    if len(tracks) < 2:
        return tracks[:1]
    share = _shares(tracks, pairs, noise, seed)
    first = (0,) * share.shape[0]
    best = _best_choice(share)
    if _mean(share, best) < _mean(share, first) + _CLEARLY:
        best = first
    choices = [best]
    least = _AS_WELL * _mean(share, best)
    for _ in tracks[1:]:
        share = _without(share, best)
        best = _best_choice(share)
        if _mean(share, best) < least:
            break
        choices.append(best)
    return [combine(tracks, choice) for choice in choices]


def attach_views(
    people: list[Sequence],
    tracks: list[Sequence],
    views: list[int],
    pairs: PairEstimation,
    noise: float,
    seed: int,
) -> list[Sequence]:
    """Return people who were told apart in the other views, one of them in each of these ``views``
    too: the person and the track of the view whose key points agree best with essential matrices.
    """
    attached = list(people[:_PEOPLE])
    seen = _Observed.of([*attached, *tracks], noise)
    others = [view for view in range(len(people[0].cameras)) if view not in views]
    for view in views:
        share = torch.zeros(len(attached), len(tracks), dtype=torch.float64)
        for person in range(len(attached)):
            for track in range(len(tracks)):
                place = len(attached) + track
                parts = [
                    seen.share(pairs, (person, other), (place, view), seed) for other in others
                ]
                share[person, track] = sum(parts) / len(parts)
        person, track = divmod(int(share.argmax()), len(tracks))
        choice = [int(other == view) for other in range(len(people[0].cameras))]
        attached[person] = combine([attached[person], tracks[track]], tuple(choice))
    return attached


def combine(tracks: list[Sequence], choice: tuple[int, ...]) -> Sequence:
    """Return the sequence that has each view of the track chosen for it."""
    return Sequence(
        title=tracks[0].title,
        source=tracks[0].source,
        cameras=tracks[0].cameras,
        frame=tracks[0].frame,
        rate_hz=tracks[0].rate_hz,
        points=KeyPointArrays(
            _by_view([track.undistorted() for track in tracks], choice),
            _by_view([track.detected() for track in tracks], choice),
        ),
        skeleton=tracks[0].skeleton,
    )


def _by_view(points: list[KeyPoints], choice: tuple[int, ...]) -> KeyPoints:
    def stack(name: str) -> np.ndarray:
        parts = [getattr(points[track], name)[:, view] for view, track in enumerate(choice)]
        return np.stack(parts, axis=1)

    return KeyPoints(stack("pixels"), stack("confidence"), stack("valid"))


def _shares(
    tracks: list[Sequence], pairs: PairEstimation, noise: float, seed: int
) -> Float[Tensor, "V P V P"]:
    """Return the share of common key points that agree, of each two tracks in two views."""
    seen = _Observed.of(tracks, noise)
    views = seen.views
    share = torch.zeros(views, len(tracks), views, len(tracks), dtype=torch.float64)
    for a, b in combinations(range(views), 2):
        for i in range(len(tracks)):
            for j in range(len(tracks)):
                share[a, i, b, j] = seen.share(pairs, (i, a), (j, b), seed)
                share[b, j, a, i] = share[a, i, b, j]
    return share


@dataclass(frozen=True)
class _Observed:
    """The joints of some frames of several sequences, whose views are side by side."""

    points: Correspondences
    views: int
    """Of each sequence."""

    @classmethod
    def of(cls, sequences: list[Sequence], noise: float) -> _Observed:
        joints = [sequence.as_joints() for sequence in sequences]
        rows = joints[0].spread(_FRAMES)
        parts = [sequence.undistorted(rows) for sequence in joints]
        pixels = torch.from_numpy(np.concatenate([part.pixels for part in parts], axis=1)).double()
        valid = torch.from_numpy(np.concatenate([part.valid for part in parts], axis=1))
        K = sequences[0].cameras.K.repeat(len(sequences), 1, 1)
        observed = observe(K, pixels, usable(K, pixels, valid), noise)
        return cls(observed, len(sequences[0].cameras))

    def share(
        self, pairs: PairEstimation, one: tuple[int, int], other: tuple[int, int], seed: int
    ) -> float:
        """Return the share of common key points that agree, of a sequence in a view with another in
        another.
        """
        places = [self.views * sequence + view for sequence, view in (one, other)]
        found = pairs.pair(self.points, places[0], places[1], seed)
        if found is None:
            return 0.0
        _, common, inliers, *_ = found
        return float(inliers / common.clamp(min=1))


def _mean(share: Float[Tensor, "V P V P"], choice: tuple[int, ...]) -> float:
    pairs = combinations(range(len(choice)), 2)
    return float(torch.stack([share[a, choice[a], b, choice[b]] for a, b in pairs]).mean())


def _best_choice(share: Float[Tensor, "V P V P"]) -> tuple[int, ...]:
    choices = [_ascend(share, track) for track in range(share.shape[1])]
    return max(choices, key=lambda choice: _mean(share, choice))


def _without(share: Float[Tensor, "V P V P"], choice: tuple[int, ...]) -> Float[Tensor, "V P V P"]:
    """Return the shares of the tracks that a choice leaves; 0 of those that it took."""
    left = share.clone()
    views = torch.arange(len(choice))
    taken = torch.tensor(choice)
    left[views, taken] = 0.0
    left[:, :, views, taken] = 0.0
    return left


def _ascend(share: Float[Tensor, "V P V P"], track: int) -> tuple[int, ...]:
    """Return the choice that a track of the first view leads to: of the others those that agree
    best with it, and then each in turn the one that agrees best with all.
    """
    choice = [track, *share[0, track, 1:].argmax(-1).tolist()]
    for _ in range(3):
        for view in range(len(choice)):
            others = [share[view, :, o, choice[o]] for o in range(len(choice)) if o != view]
            choice[view] = int(torch.stack(others).sum(0).argmax())
    return tuple(choice)
