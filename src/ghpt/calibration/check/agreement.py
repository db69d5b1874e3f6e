"""How well views agree: each view's key points against the people that the other views triangulate."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.calibration.check.setup import Look, Rays, Setup
from ghpt.geometry.cameras import Cameras
from ghpt.geometry.triangulation import triangulate_subsets
from ghpt.models.estimators.classical import Estimator, MEstimator
from ghpt.observations import Observations

LARGEST = 0.1
"""Shares of the person's size. Beyond, an error says only that nothing agrees."""
_LEAST = 20
"""Key points for a median."""


@dataclass(frozen=True)
class Agreement:
    """Of one setup. Errors are medians, in sizes of the person in the view's image."""

    core: Bool[Tensor, " V"]
    """The views that agree with each other."""
    error: Float[Tensor, " V"]
    """Held out: against the points of the core's other views; at most LARGEST."""
    points: Float[Tensor, "V F J 3"]
    """For each view what the core's other views give (all of the core where they are fewer than
    two).
    """
    known: Bool[Tensor, "V F J"]

    @property
    def cost(self) -> float:
        """Mean error."""
        return float(self.error.mean())


def errors(
    rays: Rays,
    R: Float[Tensor, "*B 3 3"],
    t: Float[Tensor, "*B 3"],
    points: Float[Tensor, "F J 3"],
    known: Bool[Tensor, "F J"],
) -> Float[Tensor, "*B F J"]:
    """Of views' rays from given points, in sizes of the person; NaN where there is nothing to
    compare, at most LARGEST (behind the camera as well).
    """
    in_camera = points @ R[..., None, :, :].mT + t[..., None, None, :]
    depth = in_camera[..., 2]
    front = depth > 0
    offset = in_camera[..., :2] / torch.where(front, depth, 1.0)[..., None] - rays.xy
    error = offset.norm(dim=-1) / rays.size[..., None].clamp(min=1e-12)
    error = torch.where(front, error, LARGEST).clamp(max=LARGEST)
    return torch.where(known & rays.valid & (rays.size > 0)[..., None], error, torch.nan)


def median(error: Float[Tensor, "*B F J"]) -> Float[Tensor, "*B"]:
    """LARGEST where too few are known."""
    flat = error.flatten(-2)
    enough = (~flat.isnan()).sum(-1) >= _LEAST
    return torch.where(enough, flat.nanmedian(-1).values.nan_to_num(LARGEST), LARGEST)


def pair_errors(
    rays: Rays, setup: Setup, pairs: Int[Tensor, "P 2"], step: int
) -> Float[Tensor, "P V"]:
    """Median error of every view from the points that a pair of views triangulates, over every
    ``step``-th frame.
    """
    xy = rays.xy[:, ::step]
    valid = rays.valid[:, ::step]
    size = rays.size[:, ::step]
    frames = xy.shape[1]
    views = len(setup)
    eye = torch.eye(views, dtype=torch.bool)
    chosen = (eye[pairs[:, 0]] | eye[pairs[:, 1]])[None, :, None].expand(
        frames, -1, xy.shape[2], -1
    )
    K = torch.eye(3, dtype=torch.float64).expand(frames, views, 3, 3)
    rig = Cameras(K, setup.R.expand(frames, -1, -1, -1), setup.t.expand(frames, -1, -1))
    points, ok = triangulate_subsets(rig, xy.transpose(0, 1), valid.transpose(0, 1), chosen)
    both = valid[pairs].all(1)
    result = torch.zeros(len(pairs), views, dtype=torch.float64)
    for p in range(len(pairs)):  # the memory of all at once is V times that of the points
        error = errors(Rays(xy, valid, size), setup.R, setup.t, points[:, p], ok[:, p])
        lost = both[p] & ~ok[:, p] & valid  # rays that meet behind a camera agree with nothing
        result[p] = median(torch.where(lost, LARGEST, error))
    return result


def all_pairs(views: int, most: int) -> Int[Tensor, "P 2"]:
    """The pairs of views, evenly thinned to at most ``most``."""
    pairs = torch.combinations(torch.arange(views), 2)
    return pairs[torch.linspace(0, len(pairs) - 1, min(most, len(pairs))).round().long()]


def core_of(pair_error: Float[Tensor, "P V"], level: float) -> Bool[Tensor, " V"]:
    """The views within ``level`` of the points of the pair that most agree with, or if none do that
    pair's.
    """
    best = pair_error.clamp(max=level).sum(-1) + 1e-3 * pair_error.sum(-1)
    row = pair_error[best.argmin()]
    core = row <= level
    if core.sum() < 2:
        core[row.topk(2, largest=False).indices] = True
    return core


def agreement(
    look: Look, setup: Setup, estimator: MEstimator, level: float, most_pairs: int
) -> Agreement:
    """Whose rays meet, and each view's held-out error."""
    rays = look.all(setup)
    step = max(1, rays.xy.shape[1] // 32)
    core = core_of(pair_errors(rays, setup, all_pairs(len(setup), most_pairs), step), level)
    points, known = triangulated(rays, setup, _without(core), estimator)
    each = [
        errors(_at(rays, v), setup.R[v], setup.t[v], points[v], known[v]) for v in range(len(setup))
    ]
    return Agreement(core, median(torch.stack(each)), points, known)


def _without(core: Bool[Tensor, " V"]) -> Bool[Tensor, "V V"]:
    """For each view the core's others; the core itself where fewer than two are left."""
    others = core & ~torch.eye(len(core), dtype=torch.bool)
    return torch.where((others.sum(-1) >= 2)[:, None], others, core)


def triangulated(
    rays: Rays, setup: Setup, used: Bool[Tensor, "G V"], estimator: Estimator
) -> tuple[Float[Tensor, "G F J 3"], Bool[Tensor, "G F J"]]:
    """Points from G choices of views by an estimator, in normalised image coordinates."""
    groups = len(used)
    frames = rays.valid.shape[1]
    valid = (rays.valid.transpose(0, 1) & used[:, None, :, None]).flatten(0, 1)
    count = groups * frames
    batch = Observations(
        index=torch.arange(count),
        recording=torch.zeros(count, dtype=torch.int64),
        cameras=Cameras(
            *(
                x.expand(count, *x.shape)
                for x in (torch.eye(3, dtype=torch.float64).expand_as(setup.R), setup.R, setup.t)
            )
        ),
        key_points=rays.xy.transpose(0, 1).repeat(groups, 1, 1, 1),
        confidence=valid.double(),
        valid=valid,
    )
    found = estimator(batch)
    return found.points.unflatten(0, (groups, frames)), found.estimated.unflatten(
        0, (groups, frames)
    )


def _at(rays: Rays, view: int) -> Rays:
    return Rays(rays.xy[view], rays.valid[view], rays.size[view])
