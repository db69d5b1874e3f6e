"""Classical estimators of a pair's relative pose, on the same correspondences as the learned one.

Correspondences are the joints that both views of the pair see, in all its frames. Thresholds are
fractions of the person's size in the image (the median, over the pair's frames and views, of the
diagonal of the box around the seen key points), so that they mean the same at any resolution and
distance. A robust estimator that fails, or finds fewer than 8 inliers, falls back to the 8-point
algorithm on all correspondences: it never gains by leaving hard pairs out.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import poselib
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.errors import check, check_positive
from ghpt.extras import check_installed
from ghpt.geometry.epipolar import MINIMUM, eight_point, pose_in_front, sampson_error
from ghpt.geometry.five_point import SAMPLE, five_point
from ghpt.models.estimators.classical import person_scale
from ghpt.models.module import StochasticEstimator
from ghpt.models.relative_pose.refinement import PoseRefinement
from ghpt.observations import PairObservations, RelativePoseEstimate
from ghpt.randomness import key, uniform


def size_in_image(batch: PairObservations) -> Float[Tensor, " B"]:
    """Return the person's size in the pair's views, in normalised image coordinates.

    It is 0 where nobody is seen.
    """
    K = batch.select_pair(batch.K)
    pixels = batch.select_pair(batch.key_points).double()
    valid = batch.select_pair(batch.valid)
    focal = (K[..., 0, 0] + K[..., 1, 1]).double() / 2
    size = person_scale(pixels, valid) / focal[..., None]
    size = torch.where(size > 0, size, torch.nan).flatten(1)
    none = torch.full((len(size), 1), torch.nan, dtype=size.dtype, device=size.device)
    median = torch.cat((size, none), dim=1).nanmedian(-1).values
    return median.nan_to_num(0.0)


def linear_pose(
    a: Float[Tensor, "*B N 2"], b: Float[Tensor, "*B N 2"], used: Bool[Tensor, "*B N"]
) -> tuple[RelativePoseEstimate, Bool[Tensor, "*B"]]:
    """Return the 8-point algorithm's pose of the used correspondences.

    Beside it is whether they determine an essential matrix.
    """
    E, determined = eight_point(a, b, used.double())
    R, t, ok = pose_in_front(E, a, b, used & determined[..., None])
    return RelativePoseEstimate(R, t, ok), determined


@dataclass(frozen=True)
class Correspondences:
    """N points that both cameras of a pair see."""

    a: Float[Tensor, "N 2"]
    b: Float[Tensor, "N 2"]
    """Normalised image coordinates in the reference and the target camera, float64."""
    size: float
    """The person's size in the images, in these coordinates."""
    index: Int[Tensor, ""]
    """The pair's own: the key of its random draws."""


class PairBaseline(ABC):
    """A classical estimator of pairs."""

    @abstractmethod
    def __call__(self, batch: PairObservations) -> RelativePoseEstimate:
        """Return float64 poses with t of length 1; each is a function of its pair alone."""


class EightPoint(PairBaseline):
    """The normalised 8-point algorithm on all correspondences."""

    @torch.no_grad()
    def __call__(self, batch: PairObservations) -> RelativePoseEstimate:
        return linear_pose(*batch.correspondences())[0]


class Robust(PairBaseline):
    """An estimator that tells inliers from outliers; ``EightPoint`` where it finds too few."""

    @abstractmethod
    def pose(self, pair: Correspondences) -> RelativePoseEstimate | None:
        """Return the pose of one pair with 8 correspondences or more, None where there is none."""

    @torch.no_grad()
    def __call__(self, batch: PairObservations) -> RelativePoseEstimate:
        a, b, used = batch.correspondences()
        size = size_in_image(batch)
        linear, determined = linear_pose(a, b, used)
        R = linear.R.clone()
        t = linear.t.clone()
        ok = linear.estimated.clone()
        for i in torch.nonzero(determined & (size > 0)).flatten().tolist():
            own = used[i]
            pair = Correspondences(a[i, own], b[i, own], size[i].item(), batch.index[i])
            found = self.pose(pair)
            if found is not None and found.estimated:
                R[i] = found.R.to(R)
                t[i] = found.t.to(t)
                ok[i] = True
        return RelativePoseEstimate(R, t, ok)


@dataclass(frozen=True)
class Ransac(Robust):
    """RANSAC with the 8-point algorithm.

    Of ``samples`` random minimal samples it takes the essential matrix with the least truncated
    squared error (MSAC), then the 8-point algorithm on its inliers.

    ``threshold``: an inlier's largest Sampson error, as a fraction of the person's size. The
    samples are keyed by ``seed`` and the pair's ``index``.
    """

    samples: int
    threshold: float
    seed: int

    def __post_init__(self) -> None:
        check_positive(samples=self.samples, threshold=self.threshold)

    def pose(self, pair: Correspondences) -> RelativePoseEstimate | None:
        a = pair.a
        b = pair.b
        keys = key(self.seed, "pair ransac", pair.index, device=a.device)
        chosen = _distinct(uniform(keys, (self.samples, MINIMUM)), len(a))
        ones = torch.ones(chosen.shape, dtype=a.dtype, device=a.device)
        E, ok = eight_point(a[chosen], b[chosen], ones)
        best, inlier = _best_essential(E, ok, pair, self.threshold)
        return linear_pose(a, b, inlier)[0] if ok[best] else None


@dataclass(frozen=True)
class FivePoint(Robust):
    """RANSAC with the 5-point algorithm.

    Of the essential matrices of ``samples`` random minimal samples it takes the one with the least
    truncated squared error (MSAC). ``threshold``, ``seed``: as of ``Ransac``.
    """

    samples: int
    threshold: float
    seed: int

    def __post_init__(self) -> None:
        check_positive(samples=self.samples, threshold=self.threshold)

    def pose(self, pair: Correspondences) -> RelativePoseEstimate | None:
        keys = key(self.seed, "pair five-point", pair.index, device=pair.a.device)
        chosen = _distinct(uniform(keys, (self.samples, SAMPLE)), len(pair.a))
        solutions, exists = five_point(pair.a[chosen], pair.b[chosen])
        E = solutions[exists]
        if not len(E):
            return None
        all_of_them = torch.ones(len(E), dtype=torch.bool, device=E.device)
        best, inlier = _best_essential(E, all_of_them, pair, self.threshold)
        R, t, ok = pose_in_front(E[best], pair.a, pair.b, inlier)
        return RelativePoseEstimate(R, t, ok)


@dataclass(frozen=True)
class Refined(PairBaseline):
    """Another estimator's pose, refined to the most likely one of all correspondences."""

    estimator: PairBaseline
    refinement: PoseRefinement

    @torch.no_grad()
    def __call__(self, batch: PairObservations) -> RelativePoseEstimate:
        return self.refinement(self.estimator(batch), batch)


@dataclass(frozen=True)
class Usac(Robust):
    """OpenCV's ``findEssentialMat`` with one of its USAC methods.

    Of the four poses it takes the one with most of its inliers in front. ``threshold``: as a
    fraction of the person's size. ``pixels``: the person's size that OpenCV sees. Its methods hold
    constants in pixels (MAGSAC's largest threshold, the cells of the neighbourhoods), so that
    neither normalised coordinates nor the camera's own resolution would do. Their random state is
    OpenCV's fixed one.
    """

    method: str
    threshold: float
    pixels: float
    confidence: float
    iterations: int

    def __post_init__(self) -> None:
        check_installed("cv2", self.method)
        import cv2

        known = [name for name in dir(cv2) if name.startswith("USAC_")]
        hint = f"Choose from {', '.join(known)}."
        check(self.method in known, "method", f"is {self.method!r}", hint)
        check_positive(threshold=self.threshold, pixels=self.pixels, iterations=self.iterations)
        possible = 0 < self.confidence < 1
        check(possible, "confidence", f"is {self.confidence}", "It must be between 0 and 1.")

    def pose(self, pair: Correspondences) -> RelativePoseEstimate | None:
        import cv2

        focal = self.pixels / pair.size
        x = (focal * pair.a).cpu().numpy()
        y = (focal * pair.b).cpu().numpy()
        K = np.diag([focal, focal, 1.0])
        method = getattr(cv2, self.method)
        threshold = self.threshold * self.pixels
        try:
            E, mask = cv2.findEssentialMat(
                x, y, K, method, self.confidence, threshold, self.iterations
            )
        except cv2.error:
            return None
        if E is None or E.shape != (3, 3) or not np.isfinite(E).all():
            return None
        inlier = torch.from_numpy(mask[:, 0] > 0).to(pair.a.device)
        if inlier.sum() < MINIMUM:
            return None
        essential = torch.from_numpy(E).to(pair.a)
        R, t, ok = pose_in_front(essential, pair.a, pair.b, inlier)
        return RelativePoseEstimate(R, t, ok)


@dataclass(frozen=True)
class PoseLib(Robust):
    """PoseLib's LO-RANSAC of the 5-point solver, then its refinement on the inliers.

    The refinement has a robust loss. ``threshold`` (largest epipolar error of an inlier) and
    ``scale`` (of the loss) are fractions of the person's size.
    """

    threshold: float
    loss: str
    scale: float
    iterations: int
    seed: int

    def __post_init__(self) -> None:
        check_positive(threshold=self.threshold, scale=self.scale, iterations=self.iterations)
        hint = f"Choose from {', '.join(_LOSSES)}."
        check(self.loss in _LOSSES, "loss", f"is {self.loss!r}", hint)

    def pose(self, pair: Correspondences) -> RelativePoseEstimate | None:
        # pixels in units of the person's size
        focal = 1 / pair.size
        parameters = [focal, focal, 0.0, 0.0]
        camera = {"model": "PINHOLE", "width": 1, "height": 1, "params": parameters}
        ransac = {
            "max_epipolar_error": self.threshold,
            "max_iterations": self.iterations,
            "seed": self.seed,
        }
        bundle = {"loss_type": self.loss, "loss_scale": self.scale}
        x = (pair.a / pair.size).cpu().numpy()
        y = (pair.b / pair.size).cpu().numpy()
        found, info = poselib.estimate_relative_pose(x, y, camera, camera, ransac, bundle)
        t = torch.tensor(found.t)
        determined = torch.isfinite(t).all() and t.any()
        if info["num_inliers"] < MINIMUM or not determined:
            return None
        return RelativePoseEstimate(torch.tensor(found.R), t / t.norm(), torch.tensor(True))


@dataclass(frozen=True)
class RefinedSelection(PairBaseline):
    """The weighted estimate of a model, refined to the most likely one of all correspondences."""

    model: StochasticEstimator
    refinement: PoseRefinement

    @torch.no_grad()
    def __call__(self, batch: PairObservations) -> RelativePoseEstimate:
        return self.refinement(self.model.sample(batch, "test").estimate("weight"), batch)


def _best_essential(
    E: Float[Tensor, "S 3 3"], ok: Bool[Tensor, " S"], pair: Correspondences, threshold: float
) -> tuple[Int[Tensor, ""], Bool[Tensor, " N"]]:
    """Return the essential matrix with the least truncated squared error, and its inliers."""
    error = sampson_error(E, pair.a, pair.b) / (threshold * pair.size)
    gain = (1 - error.square()).clamp_min(0).sum(-1)
    best = torch.where(ok, gain, -1.0).argmax()
    return best, error[best] <= 1


def _distinct(draws: Float[Tensor, "S T"], count: int) -> Int[Tensor, "S T"]:
    """Return T distinct numbers below ``count`` from T uniform draws, by Floyd's algorithm.

    Every subset is equally likely.
    """
    chosen = torch.full(draws.shape, -1, dtype=torch.int64, device=draws.device)
    for i, last in enumerate(range(count - draws.shape[1], count)):
        candidate = (draws[:, i] * (last + 1)).long()
        taken = (chosen == candidate[:, None]).any(-1)
        chosen[:, i] = torch.where(taken, last, candidate)
    return chosen


_LOSSES = ("TRIVIAL", "TRUNCATED", "HUBER", "CAUCHY", "TRUNCATED_LE_ZACH")
