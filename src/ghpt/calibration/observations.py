"""Which frames a rig is calibrated from, and their key points in one unit for all views."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.geometry.cameras import Cameras, reprojection_error
from ghpt.geometry.epipolar import normalise
from ghpt.models.estimators.classical import person_scale
from ghpt.skeleton import Skeleton


@dataclass(frozen=True)
class Correspondences:
    """Key points of N = R x J points in V views: the joints of R rows, each a person in a frame,
    side by side.
    """

    xy: Float[Tensor, "V N 2"]
    """Normalised image coordinates; 0 where not seen."""
    noise: Float[Tensor, "V N"]
    """Standard deviation that is assumed of x and of y, > 0: errors in units of it compare across
    views and joints.
    """
    valid: Bool[Tensor, "V N"]
    frame: Int[Tensor, " N"]
    """Which of the T frames a point is of."""
    joint: Int[Tensor, " N"]
    row: Int[Tensor, " N"]
    """Which of the R rows."""

    @property
    def frames(self) -> int:
        """The number T of frames."""
        return int(self.frame.max()) + 1 if len(self.frame) else 0

    def focal(self, view: int) -> float:
        """The focal length of a view whose pixel is its typical noise: what foreign solvers with
        one threshold need.
        """
        return 1 / float(self.noise[view].median())

    def error(
        self,
        R: Float[Tensor, "*H V 3 3"],
        t: Float[Tensor, "*H V 3"],
        points: Float[Tensor, "*H N 3"],
    ) -> Float[Tensor, "*H V N"]:
        """Reprojection errors in units of noise; inf behind a camera."""
        cameras = Cameras(torch.eye(3, dtype=R.dtype).expand_as(R), R, t)
        return (
            reprojection_error(cameras, self.xy.expand(*points.shape[:-2], -1, -1, -1), points)
            / self.noise
        )

    def select(self, points: Bool[Tensor, " N"]) -> Correspondences:
        """Return those of some points."""
        return Correspondences(
            self.xy[:, points],
            self.noise[:, points],
            self.valid[:, points],
            self.frame[points],
            self.joint[points],
            self.row[points],
        )

    def of_views(self, views: Int[Tensor, " W"]) -> Correspondences:
        """Return those of some views."""
        return replace(self, xy=self.xy[views], noise=self.noise[views], valid=self.valid[views])

    def with_view(self, view: int, other: Correspondences) -> Correspondences:
        """Return the same with one view's key points from another set of the same points."""
        xy = self.xy.clone()
        noise = self.noise.clone()
        valid = self.valid.clone()
        xy[view] = other.xy[view]
        noise[view] = other.noise[view]
        valid[view] = other.valid[view]
        return replace(self, xy=xy, noise=noise, valid=valid)


def usable(
    K: Float[Tensor, "V 3 3"], key_points: Float[Tensor, "T V J 2"], valid: Bool[Tensor, "T V J"]
) -> Bool[Tensor, "T V J"]:
    """Seen key points with finite numbers, in views with finite intrinsics and positive focal
    lengths.
    """
    focal = torch.stack((K[:, 0, 0], K[:, 1, 1]), dim=-1)
    usable_camera = torch.isfinite(K).all(-1).all(-1) & (focal > 0).all(-1)
    return valid & torch.isfinite(key_points).all(-1) & usable_camera[:, None]


def typical_size(
    key_points: Float[Tensor, "T V J 2"], valid: Bool[Tensor, "T V J"]
) -> Float[Tensor, " V"]:
    """Return the person's median size in each view, pixels; NaN where nobody is seen."""
    size = person_scale(key_points, valid)
    missing = torch.full_like(size[:0].sum(0), torch.nan)
    return torch.where(size > 0, size, torch.nan).nanmedian(0).values if len(size) else missing


def joints_of(
    skeleton: Skeleton, key_points: Float[Tensor, "T V K 2"], valid: Bool[Tensor, "T V K"]
) -> tuple[Float[Tensor, "T V 17 2"], Bool[Tensor, "T V 17"]]:
    """Return the 17 joints as means of a skeleton's key points, valid where all of these are."""
    weights = torch.from_numpy(skeleton.joint_weights)
    pixels = torch.where(valid[..., None], key_points.double(), 0.0)
    parts = (weights > 0).double()
    missing = (~valid).double() @ parts.T
    known = (missing == 0) & (parts.sum(1) > 0)
    return torch.where(known[..., None], weights @ pixels, 0.0), known


def spread_key_points(
    key_points: Float[Tensor, "T V K 2"], valid: Bool[Tensor, "T V K"], spacing: float
) -> Int[Tensor, " J"]:
    """Return key points, rising, of which no two are nearer to each other than ``spacing``.

    Distances are medians over frames and views, in sizes of the person. Neighbouring key points
    share a detector's errors: a face or a hand of many would count for more than it shows. The
    outermost are taken first, for limbs tell most of a rig.
    """
    count = valid.shape[2]
    size = person_scale(key_points.double(), valid)
    seen = valid & (size > 0)[..., None]
    xy = torch.where(seen[..., None], key_points.double(), torch.nan)
    xy = (xy / size.clamp(min=1e-9)[..., None, None]).flatten(0, 1)
    step = max(1, len(xy) // _ROWS_OF_DISTANCES)
    xy = xy[::step]
    apart = (xy[:, :, None] - xy[:, None]).norm(dim=-1).nanmedian(0).values if len(xy) else None
    if apart is None:
        return torch.arange(count)
    apart = apart.nan_to_num(torch.inf)
    outward = (xy - xy.nanmean(1, keepdim=True)).norm(dim=-1).nanmedian(0).values
    chosen: list[int] = []
    for place in outward.nan_to_num(-1.0).sort(descending=True, stable=True).indices.tolist():
        if all(float(apart[place, other]) >= spacing for other in chosen):
            chosen.append(place)
    return torch.tensor(sorted(chosen), dtype=torch.int64)


_ROWS_OF_DISTANCES = 400
"""Views of frames that tell how far key points are from each other."""


def choose_frames(
    key_points: Float[Tensor, "T V J 2"],
    confidence: Float[Tensor, "T V J"],
    valid: Bool[Tensor, "T V J"],
    most: int,
) -> Int[Tensor, " F"]:
    """At most ``most`` frames, in order, that cover the time and the places where the person stood.

    A frame's score is the summed confidence of its joints that two views or more see. The recording
    is cut into 4 x ``most`` equal spans, the best frame of each is a candidate; candidates are put
    into cells by where the person is in every view (in persons' sizes), and taken best of each cell
    first, then second best, and so on.
    """
    both = valid & (valid.sum(1, keepdim=True) >= 2)
    score = (confidence.double().nan_to_num(0.0).clamp(0, 1) * both).sum((1, 2))
    frames = torch.nonzero(both.any(2).any(1))[:, 0]
    if len(frames) <= most:
        return frames
    # stable: among equals the first, so the choice is the same on any machine
    order = frames[torch.sort(score[frames], descending=True, stable=True).indices]
    order = order[_rank(order * (4 * most) // len(key_points)) == 0]
    size = typical_size(key_points.double(), valid)
    count = valid.sum(2).clamp(min=1)[..., None]
    middle = torch.where(valid[..., None], key_points.double(), 0.0).sum(2) / count
    place = (middle / size.nan_to_num(1.0).clamp(min=1e-9)[:, None]).floor().clamp(-1e6, 1e6).long()
    place = torch.where(valid.any(2)[..., None], place, -(10**7)).flatten(1)[order]
    cell = torch.unique(place, dim=0, return_inverse=True)[1]
    turn = torch.sort(_rank(cell), stable=True).indices
    return order[turn[:most]].sort().values


def _rank(group: Int[Tensor, " N"]) -> Int[Tensor, " N"]:
    """How many earlier elements are of the same group."""
    order = torch.sort(group, stable=True).indices
    ordered = group[order]
    first = torch.searchsorted(ordered, ordered)
    rank = torch.empty_like(group)
    rank[order] = torch.arange(len(group)) - first
    return rank


def observe(
    K: Float[Tensor, "V 3 3"],
    key_points: Float[Tensor, "T V J 2"],
    valid: Bool[Tensor, "T V J"],
    noise: float,
    frame: Int[Tensor, " T"] | None = None,
    person: Int[Tensor, " T"] | None = None,
) -> Correspondences:
    """The chosen rows' key points, with ``noise`` x the median size of the person in the view as
    their noise. ``frame``: the number of each row's frame; None for a row a frame.
    ``person``: of each row; None for one person. Everybody's joints have numbers of their own.
    """
    key_points = torch.where(valid[..., None], key_points.double(), 0.0)
    size = typical_size(key_points, valid)
    known = torch.isfinite(size)
    sane = torch.where(known[:, None, None], K.double(), torch.eye(3, dtype=torch.float64))
    focal = (sane[:, 0, 0] * sane[:, 1, 1]).sqrt()
    xy = normalise(sane, key_points.transpose(0, 1).flatten(1, 2))
    mask = (valid & known[:, None]).transpose(0, 1).flatten(1, 2) & (xy.abs() < LARGEST).all(-1)
    unit = torch.where(known, noise * size, 1.0) / focal
    rows = key_points.shape[0]
    joints = key_points.shape[2]
    row = torch.arange(rows).repeat_interleave(joints)
    of_row = torch.arange(rows)
    if frame is not None:
        of_row = torch.unique(frame, return_inverse=True)[1]
    joint = torch.arange(joints).repeat(rows)
    if person is not None:
        joint = joint + joints * person[row]
    return Correspondences(
        torch.where(mask[..., None], xy, 0.0),
        unit[:, None].expand_as(mask).clone(),
        mask,
        of_row[row],
        joint,
        row,
    )


LARGEST = 1e6
"""A normalised coordinate beyond this is no key point."""


def reweight(
    observed: Correspondences, error: Float[Tensor, "V N"], used: Bool[Tensor, "V N"]
) -> Correspondences:
    """The same with the noise of each view, then of each joint, that the errors (in units of the
    noise so far) show: by the median over the used observations, where there are ``LEAST`` of them.
    """
    count = used.sum(0)
    # what the fit of a point to m views takes away: 3 of the 2 m numbers
    error = error * (2 * count / (2 * count - 3).clamp(min=1)).sqrt()
    masked = torch.where(used, error, torch.nan)
    by_view = _spread(masked, used)
    noise = observed.noise * by_view[:, None]
    masked = masked / by_view[:, None]
    for joint in observed.joint.unique():
        own = observed.joint == joint
        noise[:, own] *= _spread(masked[:, own].flatten()[None], used[:, own].flatten()[None])
    return replace(observed, noise=noise)


def _spread(error: Float[Tensor, "G N"], used: Bool[Tensor, "G N"]) -> Float[Tensor, " G"]:
    """Standard deviation of a coordinate from the median length of 2D errors (Rayleigh); 1 where
    there are few.
    """
    spread = error.nanmedian(-1).values.nan_to_num(1.0) / (2 * math.log(2)) ** 0.5
    return torch.where((used.sum(-1) >= LEAST) & (spread > 0), spread, 1.0)


LEAST = 20
"""Errors that a spread is estimated from."""
