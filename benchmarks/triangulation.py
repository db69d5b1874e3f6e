"""Speed and accuracy of triangulation beside its peers: ``python benchmarks/triangulation.py``.

The errors are of the same key points for all: 5 pixels of noise, one in fifty unseen, and in the
second error one detection in ten 100 pixels off. A point is one joint of one frame; for subsets, of
one hypothesis. pycolmap and the loop work point by point, so their speed is taken on fewer frames.
``pycolmap alone`` is its LO-RANSAC on cameras and arrays that are made beforehand: the fastest that
it can be called from Python. ``predict`` is its classical default with states, covariances and
swaps. The second table divides the time of twice the frames, or views, by twice the time of one: 1
is linear.

Settings: ``views=4,7,10,31`` ``frames=512`` ``loop_frames=64`` ``least=1`` (seconds for each
figure).
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pycolmap
import scene
import torch
from measure import configuration, machine, seconds, settings, show
from torch import Tensor

from ghpt import randomness
from ghpt.config import build
from ghpt.data.datasets.frames import Frames
from ghpt.geometry.subsets import random_subsets
from ghpt.geometry.triangulation import triangulate_subsets
from ghpt.models.estimators.classical import person_scale
from ghpt.models.estimators.lo_ransac import pycolmap_cameras
from ghpt.observations import Observations

HYPOTHESES = 200


def batch(views: int, frames: int) -> Observations:
    recording = scene.take("bench", frames, scene.ring(views), np.random.default_rng(views))
    return Frames([recording], np.arange(frames))[range(frames)].observations


def with_outliers(data: Observations) -> Observations:
    """One detection in ten moved by 100 pixels in a random direction."""
    generator = torch.Generator().manual_seed(0)
    shape = data.valid.shape
    angle = 2 * torch.pi * torch.rand(shape, generator=generator)
    hit = torch.rand(shape, generator=generator) < 0.1
    offset = 100 * torch.stack((angle.cos(), angle.sin()), dim=-1) * hit[..., None]
    return replace(data, key_points=data.key_points + offset)


def svd_loop(data: Observations) -> Tensor:
    """The textbook: for each point the two rows of each view in homogeneous coordinates, and a 4x4
    SVD in NumPy.
    """
    P = (data.cameras.K @ torch.cat((data.cameras.R, data.cameras.t[..., None]), dim=-1)).numpy()
    key_points, valid = data.key_points.double().numpy(), data.valid.numpy()
    points = np.zeros(data.truth.shape)
    for frame, joint in np.ndindex(points.shape[:2]):
        views = valid[frame, :, joint]
        rows = key_points[frame, views, joint, :, None] * P[frame, views, 2:] - P[frame, views, :2]
        solution = np.linalg.svd(rows.reshape(-1, 4))[2][-1]
        points[frame, joint] = solution[:3] / solution[3]
    return torch.from_numpy(points)


def pycolmap_alone(data: Observations, threshold: float) -> Callable[[], None]:
    """Its LO-RANSAC over all points, everything prepared; ``threshold`` in pixels."""
    options = pycolmap.EstimateTriangulationOptions()
    options.residual_type = pycolmap.TriangulationResidualType.REPROJECTION_ERROR
    options.ransac.max_error = threshold
    options.ransac.random_seed = 0
    tasks = []
    for frame in range(len(data)):
        rig = data.cameras.index(frame)
        found = pycolmap_cameras(rig, np.ones(len(rig.K), dtype=bool))
        for joint in range(data.valid.shape[-1]):
            views = np.flatnonzero(data.valid[frame, :, joint])
            pixels = data.key_points[frame, views, joint].double().numpy()
            tasks.append(
                (pixels, [found[1][v] for v in views], [found[0][v] for v in views], options)
            )

    def run() -> None:
        for task in tasks:
            pycolmap.estimate_triangulation(*task)

    return run


def linearity(
    views: int, frames: int, least: float, methods: dict[str, Callable[[Observations], Any]]
) -> list[Any]:
    rows = []
    for name, estimate in methods.items():
        one, long, wide = (
            seconds(lambda d=d, e=estimate: e(d), least)
            for d in (batch(views, frames), batch(views, 2 * frames), batch(2 * views, frames))
        )
        rows.append([str(views), name, f"{long / one / 2:.2f}", f"{wide / one / 2:.2f}"])
    return rows


def error(estimate: Callable[[Observations], Tensor], data: Observations) -> float:
    enough = data.valid.sum(1) >= 2
    return (estimate(data) - data.truth).norm(dim=-1)[enough].mean().item()


def main() -> None:
    wanted = settings(views="4,7,10,31", frames=512, loop_frames=64, least=1.0)
    title, baselines = machine(), build(configuration("test")["baselines"], "baselines")
    classical = build(
        configuration("estimator/default")["estimator"]["classical"], "estimator.classical"
    )
    predictor = classical(estimator=baselines[configuration("predict")["triangulation"]])
    methods = {name: (lambda d, b=b: b(d).points) for name, b in baselines.items()} | {
        "SVD loop": svd_loop
    }
    methods["predict"] = lambda d: predictor(d).points
    rows, lines = [], []
    for views in map(int, wanted["views"].split(",")):
        many, few = batch(views, wanted["frames"]), batch(views, wanted["loop_frames"])
        one = batch(views, 16)
        subsets = random_subsets(one.valid, HYPOTHESES, randomness.key(0, "benchmark", one.index))
        taken = seconds(
            lambda one=one, s=subsets: triangulate_subsets(
                one.cameras, one.key_points, one.valid, s
            ),
            wanted["least"],
        )
        rows.append(
            [
                str(views),
                "subsets, 200 hypotheses",
                f"{subsets[..., 0].numel() / taken:,.0f}",
                "",
                "",
            ]
        )
        size = person_scale(few.key_points, few.valid).mean().item()
        taken = seconds(
            pycolmap_alone(few, baselines["lo_ransac"].threshold * size), wanted["least"]
        )
        rows.append(
            [str(views), "pycolmap alone", f"{few.truth[..., 0].numel() / taken:,.0f}", "", ""]
        )
        for name, estimate in methods.items():
            data = few if name in ("lo_ransac", "SVD loop") else many
            taken = seconds(lambda d=data, e=estimate: e(d), wanted["least"])
            errors = [f"{error(estimate, d):.2f}" for d in (few, with_outliers(few))]
            label = "lo_ransac (pycolmap)" if name == "lo_ransac" else name
            rows.append([str(views), label, f"{data.truth[..., 0].numel() / taken:,.0f}", *errors])
        fast = {
            name: methods[name] for name in ("linear", "m_estimator", "adaptive_ransac", "predict")
        }
        if views <= 10:
            lines += linearity(views, wanted["frames"], wanted["least"], fast)
    show(title, ["views", "method", "points/s", "error, mm", "with outliers, mm"], rows)
    show("linear is 1", ["views", "method", "2 x frames", "2 x views"], lines)


if __name__ == "__main__":
    main()
