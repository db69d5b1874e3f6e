"""A first rig: the best-conditioned pair, then view after view against the people that the rig
triangulates.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import poselib
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.calibration.observations import Correspondences
from ghpt.calibration.pairs import PairTable, camera_dict, ransac_options
from ghpt.errors import check_positive
from ghpt.geometry.cameras import Cameras, camera_centre
from ghpt.geometry.triangulation import triangulate, triangulate_subsets
from ghpt.randomness import key, uniform


@dataclass(frozen=True)
class PlacedRig:
    """Extrinsics of the views that are ``placed`` (identity elsewhere) and the people they see, in
    one world.
    """

    R: Float[Tensor, "V 3 3"]
    t: Float[Tensor, "V 3"]
    placed: Bool[Tensor, " V"]
    points: Float[Tensor, "N 3"]
    inlier: Bool[Tensor, "V N"]
    """What agrees with its point in placed views; a point has none of it, or two or more."""

    @property
    def centre(self) -> Float[Tensor, "V 3"]:
        """The centres of the cameras in the world."""
        return camera_centre(self.R, self.t)

    def of_views(self, views: Int[Tensor, " W"]) -> PlacedRig:
        """Return some of the views."""
        return replace(
            self,
            R=self.R[views],
            t=self.t[views],
            placed=self.placed[views],
            inlier=self.inlier[views],
        )

    def select(self, points: Bool[Tensor, " N"]) -> PlacedRig:
        """Return the rig with some of the points."""
        return replace(self, points=self.points[points], inlier=self.inlier[:, points])


@dataclass(frozen=True)
class Resection:
    """How a rig is begun. ``threshold``: largest reprojection error of an inlier, in units of
    noise; a view is placed if ``least`` of its points and ``share`` of them agree. ``pairs``: pairs
    of views tried for each point where the placed ones make more. ``iterations``: the cap of
    poselib's RANSAC.
    """

    threshold: float
    least: int
    share: float
    pairs: int
    iterations: int

    def __post_init__(self) -> None:
        check_positive(
            threshold=self.threshold, least=self.least, share=self.share, pairs=self.pairs
        )
        check_positive(iterations=self.iterations)

    def begin(self, observed: Correspondences, table: PairTable, edge: int, seed: int) -> PlacedRig:
        """The rig of a pair alone, with the first view as the world."""
        a, b = table.views[edge].tolist()
        views = len(observed.valid)
        R = torch.eye(3, dtype=torch.float64).repeat(views, 1, 1)
        t = torch.zeros(views, 3, dtype=torch.float64)
        placed = torch.zeros(views, dtype=torch.bool)
        R[b] = table.R[edge]
        t[b] = table.t[edge]
        placed[[a, b]] = True
        nothing = (
            torch.zeros(len(observed.frame), 3, dtype=torch.float64),
            torch.zeros_like(observed.valid),
        )
        return self.triangulate(observed, PlacedRig(R, t, placed, *nothing), seed)

    def grow(
        self, observed: Correspondences, table: PairTable, rig: PlacedRig, seed: int
    ) -> PlacedRig:
        """Place every view that a chain of linked pairs reaches: all that the people of the placed
        views place, then those that the people of more views do.
        """
        while True:
            placed = rig.placed
            rig = self._place_all(observed, table, rig, seed)
            if torch.equal(rig.placed, placed):
                return rig
            rig = self.triangulate(observed, rig, seed)

    def _place_all(
        self, observed: Correspondences, table: PairTable, rig: PlacedRig, seed: int
    ) -> PlacedRig:
        R = rig.R.clone()
        t = rig.t.clone()
        placed = rig.placed.clone()
        inside = rig.placed[table.views]
        border = table.linked & (inside[:, 0] != inside[:, 1])
        outside = torch.where(inside[:, 0], table.views[:, 1], table.views[:, 0])
        for view in outside[border].unique().tolist():
            found = self.place(observed, rig, view, seed)
            if found is not None:
                R[view], t[view] = found
                placed[view] = True
        return replace(rig, R=R, t=t, placed=placed)

    def keep_supported(self, rig: PlacedRig) -> PlacedRig:
        """Return the rig without the views that fewer than ``least`` inliers hold, or a pair."""
        held = rig.placed & (rig.inlier.sum(1) >= self.least)
        return (
            replace(rig, placed=held, inlier=rig.inlier & held[:, None]) if held.sum() >= 2 else rig
        )

    def place(
        self, observed: Correspondences, rig: PlacedRig, view: int, seed: int
    ) -> tuple[Float[Tensor, "3 3"], Float[Tensor, " 3"]] | None:
        """A view's R, t from the rig's points by PnP with LO-RANSAC; None where too few agree."""
        used = observed.valid[view] & rig.inlier.any(0)
        if used.sum() < self.least:
            return None
        options = ransac_options(self.threshold, self.iterations, seed, "max_reproj_error")
        focal = observed.focal(view)
        pose, info = poselib.estimate_absolute_pose(
            (observed.xy[view, used] * focal).numpy(),
            rig.points[used].numpy(),
            camera_dict(focal),
            options,
            {"loss_type": "CAUCHY", "loss_scale": self.threshold / 2},
        )
        count = sum(info["inliers"])
        R = torch.from_numpy(np.array(pose.R))
        t = torch.from_numpy(np.array(pose.t))
        enough = count >= max(self.least, self.share * int(used.sum()))
        return (
            (R, t) if enough and bool(torch.isfinite(R).all() & torch.isfinite(t).all()) else None
        )

    def triangulate(self, observed: Correspondences, rig: PlacedRig, seed: int) -> PlacedRig:
        """All points anew from the placed views: of each, the pair of views with which most others
        agree, and its inliers together.
        """
        of = replace(
            observed,
            xy=observed.xy[rig.placed],
            noise=observed.noise[rig.placed],
            valid=observed.valid[rig.placed],
        )
        R = rig.R[rig.placed]
        t = rig.t[rig.placed]
        K = torch.eye(3, dtype=torch.float64).expand_as(R)
        subsets = _pairs_of_views(of.valid, self.pairs, seed)
        points, ok = triangulate_subsets(
            Cameras(K[None], R[None], t[None]), of.xy[None], of.valid[None], subsets[None]
        )
        tried = R.expand(len(subsets), -1, -1, -1), t.expand(len(subsets), -1, -1)
        error = of.error(*tried, points[0]) / self.threshold
        agree = (error <= 1) & of.valid & ok[0][:, None]
        rest = torch.where(agree, error, 0.0).sum(1) / (len(of.valid) + 1)
        best = (agree.sum(1) - rest).argmax(0)
        agree = agree.gather(0, best[None, None].expand(1, len(of.valid), -1))[0]
        result = triangulate(Cameras(K, R, t), of.xy, agree.double())
        return self.inlier_views(
            observed, replace(rig, points=result.points), result.ok & (agree.sum(0) >= 2)
        )

    def inlier_views(
        self, observed: Correspondences, rig: PlacedRig, known: Bool[Tensor, " N"]
    ) -> PlacedRig:
        """The rig with the inliers of its points where they are ``known``."""
        inlier = (
            (observed.error(rig.R, rig.t, rig.points) <= self.threshold)
            & observed.valid
            & rig.placed[:, None]
            & known
        )
        return replace(rig, inlier=inlier & (inlier.sum(0) >= 2))


def _pairs_of_views(valid: Bool[Tensor, "V N"], most: int, seed: int) -> Bool[Tensor, "H N V"]:
    """For each point every pair of views, or ``most`` random ones of those that see it."""
    views, points = valid.shape
    if views * (views - 1) // 2 <= most:
        one, other = torch.triu_indices(views, views, offset=1)
        eye = torch.eye(views, dtype=torch.bool)
        return (eye[one] | eye[other])[:, None].expand(-1, points, -1)
    count = valid.sum(0)
    draw = uniform(key(seed, "pairs of views"), (most, points, 2))
    one = (draw[..., 0] * count).long()
    other = (draw[..., 1] * (count - 1)).long()
    other = other + (other >= one)
    place = valid.T.cumsum(-1) - 1
    return valid.T & ((place == one[..., None]) | (place == other[..., None]))
