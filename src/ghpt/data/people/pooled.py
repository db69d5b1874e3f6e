"""One recording as several detectors saw it."""

from __future__ import annotations

from collections.abc import Sequence as Items
from dataclasses import replace

import numpy as np

from ghpt.data.people.sequence import KeyPointArrays, Sequence
from ghpt.data.points import KeyPoints
from ghpt.skeleton import Skeleton


def pool_detectors(detectors: Items[Items[Sequence]]) -> tuple[Sequence, ...]:
    """Return everybody whom several detectors see, before the same cameras in the same frames.

    All have one skeleton, of all key points of all detectors, and valid are those of one's own: so
    no two detectors share a key point. The 17 joints are the first detector's alone. Frames and
    cameras are those of the first sequence; others find theirs by number and name.
    """
    if len(detectors) == 1:
        return tuple(detectors[0])
    skeleton = _union([people[0].skeleton for people in detectors])
    first = detectors[0][0]
    pooled = []
    place = 0
    for people in detectors:
        for sequence in people:
            undistorted = _placed(sequence.undistorted(), sequence, first, place, len(skeleton))
            raw = _placed(sequence.detected(), sequence, first, place, len(skeleton))
            points = KeyPointArrays(undistorted, raw)
            pooled.append(replace(first, points=points, skeleton=skeleton))
        place += len(people[0].skeleton)
    return tuple(pooled)


def among_cameras(sequence: Sequence, first: Sequence) -> Sequence:
    """Return a sequence among the frames and cameras of another: nothing is seen in its others."""
    count = len(sequence.skeleton)
    undistorted = _placed(sequence.undistorted(), sequence, first, 0, count)
    raw = _placed(sequence.detected(), sequence, first, 0, count)
    return replace(first, points=KeyPointArrays(undistorted, raw), skeleton=sequence.skeleton)


def _union(skeletons: Items[Skeleton]) -> Skeleton:
    count = sum(len(each) for each in skeletons)
    first = skeletons[0]
    rest = (0.0,) * (count - len(first))
    return replace(
        first,
        name=" + ".join(each.name for each in skeletons),
        key_points=tuple(
            f"{number}: {name}" for number, each in enumerate(skeletons) for name in each.key_points
        ),
        joints=tuple((*row, *rest) for row in first.joints),
    )


def _placed(
    points: KeyPoints, sequence: Sequence, first: Sequence, place: int, count: int
) -> KeyPoints:
    """Return key points among the frames and cameras of the first sequence, from ``place`` on among
    ``count`` key points.
    """
    names = first.cameras.names
    views = [view for view, name in enumerate(sequence.cameras.names) if name in names]
    to_views = [names.index(sequence.cameras.names[view]) for view in views]
    _, to_rows, rows = np.intersect1d(first.frame, sequence.frame, return_indices=True)
    shape = (len(first), len(names), count)
    own = slice(place, place + len(sequence.skeleton))
    pixels = np.zeros((*shape, 2), points.pixels.dtype)
    confidence = np.zeros(shape, points.confidence.dtype)
    valid = np.zeros(shape, np.bool_)
    for view, to_view in zip(views, to_views, strict=True):
        pixels[to_rows, to_view, own] = points.pixels[rows, view]
        confidence[to_rows, to_view, own] = points.confidence[rows, view]
        valid[to_rows, to_view, own] = points.valid[rows, view]
    return KeyPoints(pixels, confidence, valid)
