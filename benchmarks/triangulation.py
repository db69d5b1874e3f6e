"""Speed and accuracy of triangulation beside its peers: ``python benchmarks/triangulation.py``.

The errors are of the same key points for all: 5 pixels of noise, one in fifty unseen, and in the
second error one detection in ten 100 pixels off. A point is one joint of one frame; for subsets, of
one hypothesis. pycolmap and the loop work point by point, so their speed is taken on fewer frames.
``pycolmap alone`` is its LO-RANSAC on cameras and arrays that are made beforehand: the fastest that
it can be called from Python. ``predict`` is ``estimator=frame`` with states, covariances and
exchanged sides. The second table divides the time of twice the frames, or views, by twice the time
of one: 1 is linear.

Settings: ``views=4,7,10,31`` ``frames=512`` ``loop_frames=64`` ``least=1`` (seconds for each
figure).
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

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
from ghpt.observations import Labelled, Observations, Truth

HYPOTHESES = 200


Batch = Labelled[Observations, Truth]
Method = Callable[[Observations], Tensor]


class Options(NamedTuple):
    """What the command line sets."""

    frames: int
    loop_frames: int
    least: float
    """Seconds for each figure."""


def draw_batch(views: int, frames: int) -> Batch:
    recording = scene.take("bench", frames, scene.ring(views), np.random.default_rng(views))
    return Frames([recording], np.arange(frames))[range(frames)]


def add_outliers(data: Observations) -> Observations:
    """Return the batch with one detection in ten moved by 100 pixels in a random direction."""
    generator = torch.Generator().manual_seed(0)
    shape = data.valid.shape
    angle = 2 * torch.pi * torch.rand(shape, generator=generator)
    hit = torch.rand(shape, generator=generator) < 0.1
    direction = torch.stack((angle.cos(), angle.sin()), dim=-1)
    return replace(data, key_points=data.key_points + 100 * direction * hit[..., None])


def svd_loop(data: Observations) -> Tensor:
    """The textbook: for each point the two rows of each view, and a 4x4 SVD in NumPy."""
    cameras = data.cameras
    pose = torch.cat((cameras.R, cameras.t[..., None]), dim=-1)
    P = (cameras.K @ pose).numpy()
    key_points = data.key_points.double().numpy()
    valid = data.valid.numpy()
    frames, _, joints = valid.shape
    points = np.zeros((frames, joints, 3))
    for frame, joint in np.ndindex(frames, joints):
        views = valid[frame, :, joint]
        pixels = key_points[frame, views, joint, :, None]
        rows = pixels * P[frame, views, 2:] - P[frame, views, :2]
        _, _, Vt = np.linalg.svd(rows.reshape(-1, 4))
        solution = Vt[-1]
        points[frame, joint] = solution[:3] / solution[3]
    return torch.from_numpy(points)


def prepare_pycolmap(data: Observations, threshold: float) -> Callable[[], None]:
    """Return its LO-RANSAC over all points, everything prepared; ``threshold`` in pixels."""
    options = pycolmap.EstimateTriangulationOptions()
    options.residual_type = pycolmap.TriangulationResidualType.REPROJECTION_ERROR
    options.ransac.max_error = threshold
    options.ransac.random_seed = 0
    tasks = []
    for frame in range(len(data)):
        rig = data.cameras.index(frame)
        cameras, poses = pycolmap_cameras(rig, np.ones(len(rig.K), dtype=bool))
        for joint in range(data.valid.shape[-1]):
            views = np.flatnonzero(data.valid[frame, :, joint])
            pixels = data.key_points[frame, views, joint].double().numpy()
            own_poses = [poses[v] for v in views]
            own_cameras = [cameras[v] for v in views]
            tasks.append((pixels, own_poses, own_cameras, options))

    def run() -> None:
        for task in tasks:
            pycolmap.estimate_triangulation(*task)

    return run


def measure_error(method: Method, data: Observations, truth: Truth) -> float:
    """Return the mean error of joints that two views see, mm."""
    enough = data.valid.sum(1) >= 2
    error = (method(data) - truth.points).norm(dim=-1)
    return error[enough].mean().item()


def points_per_second(count: int, duration: float) -> str:
    return f"{count / duration:,.0f}"


def measure_subsets(views: int, options: Options) -> list[str]:
    one = draw_batch(views, 16).observations
    keys = randomness.key(0, "benchmark", one.index)
    subsets = random_subsets(one.valid, HYPOTHESES, keys)

    def run() -> None:
        triangulate_subsets(one.cameras, one.key_points, one.valid, subsets)

    speed = points_per_second(subsets[..., 0].numel(), seconds(run, options.least))
    return [str(views), "subsets, 200 hypotheses", speed, "", ""]


def measure_pycolmap(views: int, few: Batch, threshold: float, options: Options) -> list[str]:
    data = few.observations
    size = person_scale(data.key_points, data.valid).mean().item()
    duration = seconds(prepare_pycolmap(data, threshold * size), options.least)
    return [
        str(views),
        "pycolmap alone",
        points_per_second(few.truth.valid.numel(), duration),
        "",
        "",
    ]


def measure_method(
    views: int,
    name: str,
    method: Method,
    batches: tuple[Batch, Batch],
    options: Options,
) -> list[str]:
    """Return the row of a method; ``batches``: many frames, and few for errors and slow methods."""
    many, few = batches
    timed = few if name in ("lo_ransac", "SVD loop") else many
    duration = seconds(lambda: method(timed.observations), options.least)
    speed = points_per_second(timed.truth.valid.numel(), duration)
    clean = measure_error(method, few.observations, few.truth)
    spoilt = measure_error(method, add_outliers(few.observations), few.truth)
    label = "lo_ransac (pycolmap)" if name == "lo_ransac" else name
    return [str(views), label, speed, f"{clean:.2f}", f"{spoilt:.2f}"]


def measure_linearity(views: int, name: str, method: Method, options: Options) -> list[str]:
    """Return the time of twice the frames, or views, over twice the time of one."""

    def measure(views: int, frames: int) -> float:
        data = draw_batch(views, frames).observations
        return seconds(lambda: method(data), options.least)

    one = measure(views, options.frames)
    long = measure(views, 2 * options.frames)
    wide = measure(2 * views, options.frames)
    return [str(views), name, f"{long / one / 2:.2f}", f"{wide / one / 2:.2f}"]


def make_methods(baselines: dict[str, Any]) -> dict[str, Method]:
    """Return all estimators of single frames, the loop, and what predict makes of one."""
    config = configuration("predictor/default")["predictor"]["classical"]
    classical = build(config, "predictor.classical")
    predictor = classical(estimator=baselines["adaptive_ransac"])
    methods: dict[str, Method] = {}
    for name, baseline in baselines.items():
        methods[name] = lambda data, baseline=baseline: baseline(data).points
    methods["SVD loop"] = svd_loop
    methods["predict"] = lambda data: predictor(data).points
    return methods


def main() -> None:
    wanted = settings(views="4,7,10,31", frames=512, loop_frames=64, least=1.0)
    options = Options(wanted["frames"], wanted["loop_frames"], wanted["least"])
    title = machine()
    baselines = build(configuration("test")["baselines"], "baselines")
    methods = make_methods(baselines)
    rows = []
    lines = []
    for views in map(int, wanted["views"].split(",")):
        many = draw_batch(views, options.frames)
        few = draw_batch(views, options.loop_frames)
        rows.append(measure_subsets(views, options))
        rows.append(measure_pycolmap(views, few, baselines["lo_ransac"].threshold, options))
        for name, method in methods.items():
            rows.append(measure_method(views, name, method, (many, few), options))
        if views <= 10:
            for name in ("linear", "m_estimator", "adaptive_ransac", "predict"):
                lines.append(measure_linearity(views, name, methods[name], options))
    show(title, ["views", "method", "points/s", "error, mm", "with outliers, mm"], rows)
    show("linear is 1", ["views", "method", "2 x frames", "2 x views"], lines)


if __name__ == "__main__":
    main()
