"""Persons told apart in the views of calibrated cameras.

The detections of a frame that agree on one body in space are one person's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.data.people.tracks import Bodies, box_diagonal, join_tracks, track_bodies
from ghpt.data.points import KeyPoints
from ghpt.geometry.cameras import Cameras, project, relative_pose
from ghpt.geometry.epipolar import fundamental, homogeneous
from ghpt.geometry.normal_equations import local_cameras
from ghpt.geometry.triangulation import triangulate
from ghpt.skeleton import BONES

_FAR = 0.12
"""Distance of a joint, as a part of the size of the person in the image, at which it says nothing
for a body.
"""
_AGREE = 0.4
"""A detection agrees with a body that it supports by more, of at most 1."""
_LEAST_JOINTS = 4
"""Joints that a detection and a body must share to be compared."""
_PARTNERS = 4
"""Views with which each view is paired; of fewer than twice as many views all pairs are tried."""
_SEEDS = 48
"""Pairs of detections of a frame that are tried as bodies at once: those that agree best."""
_ROUNDS = 8
"""How often seeds are sought among the detections that no body has taken."""
_SAME = 0.06
"""Bodies of a frame are one if the median distance of their joints is below this part of the
height.
"""
_VALUES = 1 << 21
"""Distances that are in memory at once."""


@dataclass(frozen=True)
class _Candidates:
    """The detections of T frames, padded to P in each view."""

    index: Int[Tensor, "T V P"]
    """Of the detection; -1 where there is none."""
    points: Float[Tensor, "T V P J 2"]
    valid: Bool[Tensor, "T V P J"]
    scale: Float[Tensor, "T V P"]
    """Diagonal of the box around the joints, pixels."""


@dataclass(frozen=True)
class _Pairs:
    """Q pairs of views, with what relates their pixels."""

    views: Int[Tensor, "Q 2"]
    F: Float[Tensor, "Q 3 3"]
    """Fundamental matrices: ``x_second^T F x_first = 0``."""


def associate(
    cameras: Cameras,
    frames: int,
    row: Int[np.ndarray, " N"],
    view: Int[np.ndarray, " N"],
    points: KeyPoints,
    identity: Int[np.ndarray, " N"] | None = None,
    bones: Sequence[tuple[int, int]] = BONES,
) -> list[Int[np.ndarray, "T V"]]:
    """Return for each person the index of their detection in each frame and view.

    It is -1 where there is none; the best person comes first. ``row`` and ``view`` are those of the
    N detections, whose undistorted key points are ``points`` [N J]. ``identity`` is the number that
    a tracker of the view gave each, -1 where none did; it means nothing in another view. ``bones``
    are the pairs of joints whose distances tell people apart who are not there together.

    1. Within a frame, two detections in two views make a body if they lie near one another's
       epipolar lines. It is projected into all views, where those detections support it that are
       near.
    2. The best supported body takes its detections, then the best of the rest, as long as two views
       agree; at last each detection goes to the body, from all of its views, that it supports most.
    3. Bodies of successive frames are tracked, and tracks joined to persons (`join_tracks`).
    4. The best person has the greatest sum, over frames and views, of size times mean confidence,
       over that of the best in the view.
    """
    if not len(row) or len(cameras.K) < 2:
        return []
    scale = box_diagonal(points.pixels, points.valid)
    prominence = _prominence(points, scale, view)
    local, _ = local_cameras(cameras.to(torch.float64))
    pairs = _view_pairs(local)
    members = []
    parts = []
    for table, start in _tables(frames, len(cameras.K), row, view, prominence, len(pairs.views)):
        candidates = _pad(table, points, scale)
        found, frame = _group(local, pairs, candidates)
        members.append(found)
        parts.append(_triangulate_bodies(local, found, frame + start, points))
    chosen = np.concatenate(members)
    own = np.full(chosen.shape, -1)
    if identity is not None:
        own = np.where(chosen >= 0, identity[chosen], -1)
    bodies = Bodies(
        frame=np.concatenate([part.frame for part in parts]),
        points=np.concatenate([part.points for part in parts]),
        valid=np.concatenate([part.valid for part in parts]),
        identity=own,
        bones=tuple(bones),
    )
    worth = np.where(chosen >= 0, prominence[chosen], 0).sum(1)
    return join_tracks(frames, bodies, track_bodies(bodies), worth, chosen)


def _prominence(
    points: KeyPoints, scale: Float[np.ndarray, " N"], view: Int[np.ndarray, " N"]
) -> Float[np.ndarray, " N"]:
    """Return each detection's size times mean confidence, over that of the best in its view."""
    confidence = np.where(points.valid, points.confidence, 0).mean(-1)
    prominence = scale * confidence
    views = range(int(view.max(initial=0)) + 1)
    best = np.array([prominence[view == v].max(initial=0) for v in views])
    return prominence / np.maximum(best, 1e-9)[view]


def _tables(
    frames: int,
    views: int,
    row: Int[np.ndarray, " N"],
    view: Int[np.ndarray, " N"],
    prominence: Float[np.ndarray, " N"],
    pairs: int,
) -> list[tuple[Int[np.ndarray, "t V P"], int]]:
    """Return the indices of the detections of each frame and view, the best first.

    They come in tables of successive frames, with the first frame of each.
    """
    order = np.lexsort((-prominence, view, row))
    cell = (row * views + view)[order]
    starts = np.flatnonzero(np.diff(cell, prepend=-1))
    lengths = np.diff(starts, append=len(cell))
    rank = np.arange(len(cell)) - np.repeat(starts, lengths)
    most = np.zeros(frames, np.int64)
    np.maximum.at(most, cell // views, rank + 1)
    cost = np.maximum(pairs * most**2, _SEEDS * views * most) * 17
    chunk = np.cumsum(cost) // _VALUES
    firsts = np.flatnonzero(np.diff(chunk, prepend=-1))
    tables = []
    for start, end in zip(firsts, [*firsts[1:], frames], strict=True):
        inside = slice(*np.searchsorted(cell, [start * views, end * views]))
        table = np.full(((end - start) * views, most[start:end].max(initial=1)), -1)
        table[cell[inside] - start * views, rank[inside]] = order[inside]
        tables.append((table.reshape(end - start, views, -1), int(start)))
    return tables


def _view_pairs(cameras: Cameras) -> _Pairs:
    """Return the pairs of views in which bodies are sought.

    They are all pairs of a few views. Of more, each view is paired with its nearest cameras, and
    with those that look in directions nearest to a right angle to its own.
    """
    count = len(cameras.K)
    if count <= 2 * _PARTNERS + 1:
        views = torch.tensor(list(combinations(range(count), 2)))
    else:
        forward = cameras.R[:, 2]
        parallel = (forward @ forward.mT).abs().fill_diagonal_(torch.inf)
        distance = torch.cdist(cameras.centre, cameras.centre).fill_diagonal_(torch.inf)
        ranked = [distance.argsort(dim=1), parallel.argsort(dim=1)]
        partner = torch.cat([order[:, : _PARTNERS // 2] for order in ranked], dim=1)
        first = torch.arange(count)[:, None].expand_as(partner)
        both = torch.stack([first, partner], -1).reshape(-1, 2)
        views = both.sort(dim=1).values.unique(dim=0)
    first, second = views.mT
    R, t = relative_pose(cameras.R[first], cameras.t[first], cameras.R[second], cameras.t[second])
    return _Pairs(views, fundamental(cameras.K[first], cameras.K[second], R, t))


def _pad(
    table: Int[np.ndarray, "T V P"], points: KeyPoints, scale: Float[np.ndarray, " N"]
) -> _Candidates:
    there = table >= 0
    valid = points.valid[table] & there[..., None]
    return _Candidates(
        index=torch.from_numpy(table),
        points=torch.from_numpy(points.pixels[table].astype(np.float64)),
        valid=torch.from_numpy(valid),
        scale=torch.from_numpy(np.maximum(scale[table], 1e-9).astype(np.float64)),
    )


def _group(
    cameras: Cameras, pairs: _Pairs, candidates: _Candidates
) -> tuple[Int[np.ndarray, "G V"], Int[np.ndarray, " G"]]:
    """Return the detections of each body, and its frame."""
    agreement = _agreement(pairs, candidates)
    rays = _rays(cameras, candidates.points)
    taken = candidates.index < 0
    members = []
    frames = []
    for _ in range(_ROUNDS):
        support, tried = _try_seeds(cameras, pairs, candidates, rays, agreement, taken)
        if not tried:
            break
        found = _take_bodies(support, taken)
        members += [person for person, _ in found]
        frames += [frame for _, frame in found]
    if not members:
        return np.zeros((0, len(cameras.K)), np.int64), np.zeros(0, np.int64)
    return _settle(cameras, candidates, torch.cat(members), torch.cat(frames))


def _agreement(pairs: _Pairs, candidates: _Candidates) -> Float[Tensor, "T Q P P"]:
    """Return how near two detections are to one another's epipolar lines.

    It is the mean, over the joints that both have, of 1 - distance / (2 x _FAR x scale), at least
    0, which is at least how much both support the body that they make; and 0 where they share too
    few joints.
    """
    first, second = pairs.views.mT
    reach = 2 * _FAR * candidates.scale
    a = homogeneous(candidates.points[:, first])
    b = homogeneous(candidates.points[:, second])
    F = pairs.F[:, None, None]
    toward_b = _line_distance((F @ a[..., None])[..., 0][:, :, :, None], b[:, :, None])
    toward_a = _line_distance((F.mT @ b[..., None])[..., 0][:, :, None], a[:, :, :, None])
    relative = torch.maximum(
        toward_b / reach[:, second][:, :, None, :, None],
        toward_a / reach[:, first][:, :, :, None, None],
    )
    both = candidates.valid[:, first][:, :, :, None] & candidates.valid[:, second][:, :, None]
    near = torch.where(both, (1 - relative).clamp(min=0), 0.0)
    count = both.sum(-1)
    mean = near.sum(-1) / count.clamp(min=1)
    return torch.where(count >= _LEAST_JOINTS, mean, 0.0)


def _line_distance(
    line: Float[Tensor, "*B 3"], point: Float[Tensor, "*B 3"]
) -> Float[Tensor, "*B"]:
    """Return the distance of points from lines of the image; inf from a line that is none."""
    length = torch.hypot(line[..., 0], line[..., 1])
    distance = (line[..., 0] * point[..., 0]).addcmul(line[..., 1], point[..., 1])
    distance = distance.addcmul(line[..., 2], point[..., 2]).abs() / length
    return distance.nan_to_num_(nan=torch.inf)


def _rays(cameras: Cameras, points: Float[Tensor, "T V P J 2"]) -> Float[Tensor, "T V P J 3"]:
    """Return the unit directions of pixels in the world."""
    to_world = cameras.R.mT @ torch.linalg.inv(cameras.K)
    ray = (to_world[:, None, None] @ homogeneous(points)[..., None])[..., 0]
    return torch.nn.functional.normalize(ray, dim=-1)


def _try_seeds(
    cameras: Cameras,
    pairs: _Pairs,
    candidates: _Candidates,
    rays: Float[Tensor, "T V P J 3"],
    agreement: Float[Tensor, "T Q P P"],
    taken: Bool[Tensor, "T V P"],
) -> tuple[Float[Tensor, "T S V P"], bool]:
    """Return the support of the best seeds of free detections, and whether there is any seed.

    Sets the ``agreement`` of what was tried to 0.
    """
    frames, _, people, _ = agreement.shape
    first, second = pairs.views.mT
    free = ~taken
    open_pairs = free[:, first][..., None] & free[:, second][:, :, None]
    value = torch.where(open_pairs, agreement, 0.0).flatten(1)
    best, at = value.topk(min(_SEEDS, value.shape[1]), dim=1)
    count = int((best > _AGREE).sum(1).max())
    best = best[:, :count]
    at = at[:, :count]
    agreement.flatten(1).scatter_(1, at, 0.0)
    frame = torch.arange(frames)[:, None]
    pair = at // people**2
    one = first[pair], at // people % people
    other = second[pair], at % people
    points, ok = _midpoints(
        cameras.centre[one[0]],
        rays[frame, one[0], one[1]],
        cameras.centre[other[0]],
        rays[frame, other[0], other[1]],
    )
    ok &= candidates.valid[frame, one[0], one[1]] & candidates.valid[frame, other[0], other[1]]
    ok &= (best > _AGREE)[..., None]
    return _support(cameras, points, ok, candidates), count > 0


def _midpoints(
    centre: Float[Tensor, "*B 3"],
    ray: Float[Tensor, "*B J 3"],
    other_centre: Float[Tensor, "*B 3"],
    other_ray: Float[Tensor, "*B J 3"],
) -> tuple[Float[Tensor, "*B J 3"], Bool[Tensor, "*B J"]]:
    """Return the points nearest to two rays, and whether they are before both cameras."""
    offset = (centre - other_centre)[..., None, :]
    cosine = (ray * other_ray).sum(-1)
    along = (ray * offset).sum(-1)
    other_along = (other_ray * offset).sum(-1)
    square_sine = (1 - cosine**2).clamp(min=1e-12)
    depth = (cosine * other_along - along) / square_sine
    other_depth = (other_along - cosine * along) / square_sine
    one = centre[..., None, :] + depth[..., None] * ray
    other = other_centre[..., None, :] + other_depth[..., None] * other_ray
    ok = (depth > 0) & (other_depth > 0) & (square_sine > 1e-8)
    return (one + other) / 2, ok


def _support(
    cameras: Cameras,
    points: Float[Tensor, "T S J 3"],
    ok: Bool[Tensor, "T S J"],
    candidates: _Candidates,
) -> Float[Tensor, "T S V P"]:
    """Return how much each detection of its frame supports each body.

    It is the mean, over the joints that both have, of 1 - distance / (_FAR x scale), at least 0;
    and 0 where they share too few.
    """
    projected, depth = project(cameras, points)
    visible = ok[:, :, None] & (depth > 0)
    both = visible[:, :, :, None] & candidates.valid[:, None]
    x, y = projected[:, :, :, None].unbind(-1)
    u, v = candidates.points[:, None].unbind(-1)
    distance = torch.hypot(x - u, y - v)
    reach = (_FAR * candidates.scale)[:, None, ..., None]
    near = torch.where(both, (1 - distance / reach).clamp(min=0), 0.0)
    count = both.sum(-1)
    mean = near.sum(-1) / count.clamp(min=1)
    return torch.where(count >= _LEAST_JOINTS, mean, 0.0)


def _take_bodies(
    support: Float[Tensor, "T S V P"], taken: Bool[Tensor, "T V P"]
) -> list[tuple[Int[Tensor, "G V"], Int[Tensor, " G"]]]:
    """Return the detections of the best supported bodies, and their frames.

    What they take is marked in ``taken``.
    """
    found: list[tuple[Tensor, Tensor]] = []
    while True:
        most, detection = torch.where(taken[:, None], 0.0, support).max(-1)
        agrees = most > _AGREE
        enough = agrees.sum(-1) >= 2
        frame = torch.nonzero(enough.any(-1))[:, 0]
        if not len(frame):
            return found
        total = torch.where(agrees, most, 0.0).sum(-1)
        best = torch.where(enough, total, -1.0).argmax(-1)[frame]
        person = torch.where(agrees[frame, best], detection[frame, best], -1)
        at = torch.nonzero(person >= 0)
        taken[frame[at[:, 0]], at[:, 1], person[person >= 0]] = True
        found.append((person, frame))


def _settle(
    cameras: Cameras, candidates: _Candidates, members: Int[Tensor, "G V"], frame: Int[Tensor, " G"]
) -> tuple[Int[np.ndarray, "G V"], Int[np.ndarray, " G"]]:
    """Give each detection to the body that it supports most.

    The body gets it if none supports that body more in this view.
    """
    views = torch.arange(members.shape[1])
    order = frame.argsort(stable=True)
    members = members[order]
    frame = frame[order]
    own = (frame[:, None], views, members)
    valid = candidates.valid[own] & (members >= 0)[..., None]
    found = triangulate(cameras, candidates.points[own], valid.double())
    count = torch.bincount(frame, minlength=len(candidates.index))
    place = torch.arange(len(frame)) - (count.cumsum(0) - count)[frame]
    shape = (len(candidates.index), int(count.max()), found.ok.shape[-1])
    points = found.points.new_zeros(*shape, 3)
    ok = torch.zeros(shape, dtype=torch.bool)
    points[frame, place] = found.points
    ok[frame, place] = found.ok
    ok &= ~_find_repeated(points, ok)[..., None]
    support = _support(cameras, points, ok, candidates)
    support = torch.where(candidates.index[:, None] < 0, 0.0, support)
    strongest = torch.where(support >= support.amax(1, keepdim=True), support, 0.0)
    value, detection = strongest[frame, place].max(-1)
    index = candidates.index[frame].gather(2, detection[..., None])[..., 0]
    settled = torch.where(value > _AGREE, index, -1)
    kept = (settled >= 0).sum(-1) >= 2
    return settled[kept].numpy(), frame[kept].numpy()


def _find_repeated(
    points: Float[Tensor, "T B J 3"], ok: Bool[Tensor, "T B J"]
) -> Bool[Tensor, "T B"]:
    """Return which bodies are an earlier one of their frame again, listed twice by a detector."""
    both = ok[:, :, None] & ok[:, None]
    distance = torch.linalg.vector_norm(points[:, :, None] - points[:, None], dim=-1)
    distance = torch.where(both, distance, torch.nan).nanmedian(-1).values
    low = torch.where(ok[..., None], points, torch.inf).amin(2)
    high = torch.where(ok[..., None], points, -torch.inf).amax(2)
    height = torch.linalg.vector_norm(high - low, dim=-1).nan_to_num(0.0)
    same = distance < _SAME * height[..., None]
    return same.tril(-1).any(-1)


def _triangulate_bodies(
    cameras: Cameras,
    members: Int[np.ndarray, "G V"],
    frame: Int[np.ndarray, " G"],
    points: KeyPoints,
) -> Bodies:
    valid = points.valid[members] & (members >= 0)[..., None]
    pixels = torch.from_numpy(points.pixels[members].astype(np.float64))
    found = triangulate(cameras, pixels, torch.from_numpy(valid).double())
    return Bodies(frame, found.points.numpy(), found.ok.numpy(), members, ())
