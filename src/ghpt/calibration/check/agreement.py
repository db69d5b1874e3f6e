"""How well views agree: each view's key points against the people that the other views give."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.calibration.check.setup import RayCache, Rays, Setup
from ghpt.geometry.cameras import Cameras
from ghpt.geometry.triangulation import triangulate_subsets
from ghpt.models.estimators.classical import Estimator
from ghpt.observations import Observations

LARGEST = 0.1
"""Shares of the person's size. Beyond, an error says only that nothing agrees."""
_LEAST = 20
"""Key points for a median."""


@dataclass(frozen=True)
class Agreement:
    """How well the views of one setup agree. Errors are medians, in sizes of the person."""

    core: Bool[Tensor, " V"]
    """The views that agree with each other."""
    error: Float[Tensor, " V"]
    """Held out: from the points of the core's other views; at most LARGEST."""
    points: Float[Tensor, "V F J 3"]
    """For each view what the core's other views give; all of the core where fewer than two are
    left.
    """
    known: Bool[Tensor, "V F J"]
    course: Float[Tensor, "F V"]
    """The held-out errors of each frame; NaN where nothing is compared."""

    @property
    def cost(self) -> float:
        """The mean error of all views."""
        return float(self.error.mean())


def errors(
    rays: Rays,
    R: Float[Tensor, "*B 3 3"],
    t: Float[Tensor, "*B 3"],
    points: Float[Tensor, "F J 3"],
    known: Bool[Tensor, "F J"],
) -> Float[Tensor, "*B F J"]:
    """Return the errors of views' rays from points, in sizes of the person.

    At most LARGEST, as behind the camera; NaN where there is nothing to compare.
    """
    in_camera = points @ R[..., None, :, :].mT + t[..., None, None, :]
    depth = in_camera[..., 2]
    front = depth > 0
    safe_depth = torch.where(front, depth, 1.0)[..., None]
    offset = in_camera[..., :2] / safe_depth - rays.xy
    error = offset.norm(dim=-1) / rays.size[..., None].clamp(min=1e-12)
    error = torch.where(front, error, LARGEST).clamp(max=LARGEST)
    comparable = known & rays.valid & (rays.size > 0)[..., None]
    return torch.where(comparable, error, torch.nan)


def median(error: Float[Tensor, "*B F J"]) -> Float[Tensor, "*B"]:
    """Return the median of the errors; LARGEST where too few are known."""
    flat = error.flatten(-2)
    enough = (~flat.isnan()).sum(-1) >= _LEAST
    middle = flat.nanmedian(-1).values.nan_to_num(LARGEST)
    return torch.where(enough, middle, LARGEST)


def pair_errors(
    rays: Rays, setup: Setup, pairs: Int[Tensor, "P 2"], step: int
) -> Float[Tensor, "P V"]:
    """Return the median error of every view from the points that each pair of views triangulates,
    over every ``step``-th frame.
    """
    xy = rays.xy[:, ::step]
    valid = rays.valid[:, ::step]
    size = rays.size[:, ::step]
    joints = xy.shape[2]
    frames = xy.shape[1]
    is_view = torch.eye(len(setup), dtype=torch.bool)
    in_pair = is_view[pairs[:, 0]] | is_view[pairs[:, 1]]
    chosen = in_pair[None, :, None].expand(frames, -1, joints, -1)
    rig = _normalised_cameras(setup).expand(frames)
    points, ok = triangulate_subsets(rig, xy.transpose(0, 1), valid.transpose(0, 1), chosen)
    both = valid[pairs].all(1)
    result = torch.zeros(len(pairs), len(setup), dtype=torch.float64)
    for p in range(len(pairs)):  # the memory of all at once is V times that of the points
        error = errors(Rays(xy, valid, size), setup.R, setup.t, points[:, p], ok[:, p])
        lost = both[p] & ~ok[:, p] & valid  # rays that meet behind a camera agree with nothing
        result[p] = median(torch.where(lost, LARGEST, error))
    return result


def all_pairs(views: int, most: int) -> Int[Tensor, "P 2"]:
    """Return the pairs of views, evenly thinned to at most ``most``."""
    pairs = torch.combinations(torch.arange(views), 2)
    count = min(most, len(pairs))
    return pairs[torch.linspace(0, len(pairs) - 1, count).round().long()]


def core_of(pair_error: Float[Tensor, "P V"], level: float) -> Bool[Tensor, " V"]:
    """Return the views within ``level`` of the points of the pair that most views agree with; the
    two best of it where fewer are.
    """
    cost = pair_error.clamp(max=level).sum(-1) + 1e-3 * pair_error.sum(-1)
    row = pair_error[cost.argmin()]
    core = row <= level
    if core.sum() < 2:
        core[row.topk(2, largest=False).indices] = True
    return core


def agreement(
    cache: RayCache, setup: Setup, estimator: Estimator, level: float, most_pairs: int
) -> Agreement:
    """Return the views whose rays meet, and each view's held-out error."""
    rays = cache.all(setup)
    views = len(setup)
    step = max(1, rays.xy.shape[1] // 32)
    pair_error = pair_errors(rays, setup, all_pairs(views, most_pairs), step)
    core = core_of(pair_error, level)
    points, known = triangulate_choices(rays, setup, _without_each(core), estimator)
    each = [
        errors(_rays_of_view(rays, v), setup.R[v], setup.t[v], points[v], known[v])
        for v in range(views)
    ]
    error = torch.stack(each)
    course = error.nanmedian(-1).values.T
    return Agreement(core, median(error), points, known, course)


def triangulate_choices(
    rays: Rays, setup: Setup, used: Bool[Tensor, "G V"], estimator: Estimator
) -> tuple[Float[Tensor, "G F J 3"], Bool[Tensor, "G F J"]]:
    """Return the points of G choices of views by an estimator, in the cameras' unit."""
    groups = len(used)
    frames = rays.valid.shape[1]
    valid_by_frame = rays.valid.transpose(0, 1)
    valid = (valid_by_frame & used[:, None, :, None]).flatten(0, 1)
    count = groups * frames
    batch = Observations(
        index=torch.arange(count),
        recording=torch.zeros(count, dtype=torch.int64),
        cameras=_normalised_cameras(setup).expand(count),
        key_points=rays.xy.transpose(0, 1).repeat(groups, 1, 1, 1),
        confidence=valid.double(),
        valid=valid,
    )
    found = estimator(batch)
    shape = (groups, frames)
    return found.points.unflatten(0, shape), found.estimated.unflatten(0, shape)


def _normalised_cameras(setup: Setup) -> Cameras:
    """Return the cameras whose pixels are normalised image coordinates."""
    K = torch.eye(3, dtype=torch.float64).expand_as(setup.R)
    return Cameras(K, setup.R, setup.t)


def _without_each(core: Bool[Tensor, " V"]) -> Bool[Tensor, "V V"]:
    """Return for each view the core's others; the core itself where fewer than two are left."""
    others = core & ~torch.eye(len(core), dtype=torch.bool)
    enough = others.sum(-1) >= 2
    return torch.where(enough[:, None], others, core)


def _rays_of_view(rays: Rays, view: int) -> Rays:
    return Rays(rays.xy[view], rays.valid[view], rays.size[view])
