"""Relative poses of camera pairs, and whole rigs: ``python benchmarks/relative_pose.py``.

The first table: 100 hypotheses of a pair (generate and describe, in batches as in testing) beside
USAC_ACCURATE of OpenCV and PoseLib together, on the same correspondences, with the settings of
conf/camera_baselines. Only their own calls are timed, not how their input is prepared; ours holds
that too. They take turns in one run, so that a busy machine slows both; the ratio is the median
over the rounds. The second: calibration of rigs of 4 and of 31 cameras.

The correspondences are of the synthetic Human3.6M and Panoptic (test splits; the first
run prepares them).

Settings: ``frames=80`` ``batch=12`` (pairs; two draws of a rig of four cameras) ``rounds=15``
``threads=2`` ``rigs=3`` (draws of each rig; 0: leave the rigs out).
"""

import statistics
import time
import warnings

import torch
from measure import configuration, machine, settings, show

from ghpt import randomness
from ghpt.config import build
from ghpt.data.datasets.pairs import Pairs, PairSettings
from ghpt.models.relative_pose.baselines import Correspondences, Robust, size_in_image
from ghpt.observations import PairObservations

THEIRS = ("usac_accurate", "poselib")


def draws(data: str, frames: int, count: int) -> Pairs:
    """``count`` draws of M frames for each rig of the synthetic test split."""
    module = build(configuration("test", f"data={data}")["data"], "data")
    module.setup("test")
    return Pairs(module.frames["test"].recordings, PairSettings(frames, count, points=1), seed=0)


def solve(baseline: Robust, batch: PairObservations) -> list[float]:
    """Seconds that the solver itself takes for each pair."""
    a, b, used = batch.correspondences()
    size = size_in_image(batch).tolist()
    taken = []
    for i in range(len(batch)):
        pair = Correspondences(a[i, used[i]], b[i, used[i]], size[i], batch.index[i])
        start = time.perf_counter()
        baseline.pose(pair)
        taken.append(time.perf_counter() - start)
    return taken


def race(frames: int, size: int, rounds: int) -> list[list[str]]:
    """Milliseconds a pair of ours and theirs, and the ratio, in turns."""
    pairs = draws("h36m", frames, -(-size * rounds // 12))
    model = build(configuration("train", "model=camera")["model"], "model")
    baselines = build(configuration("test")["camera_baselines"], "camera_baselines")
    ours = []
    theirs = {name: [] for name in THEIRS}
    for number in range(-1, rounds):
        first = max(number, 0) * size % (len(pairs) - size + 1)
        batch = pairs[range(first, first + size)].observations
        keys = randomness.key(0, "benchmark", batch.index)
        start = time.perf_counter()
        model.problem.featurize(model.problem.generate(batch, model.hypotheses, keys))
        taken = time.perf_counter() - start
        solved = {name: sum(solve(baselines[name], batch)) for name in THEIRS}
        if number >= 0:  # the first warms up
            ours.append(taken)
            for name, duration in solved.items():
                theirs[name].append(duration)
    both = [sum(x) for x in zip(*theirs.values(), strict=True)]
    ratios = sorted(a / b for a, b in zip(ours, both, strict=True))
    rows = [[f"ours, {model.hypotheses} hypotheses", f"{_ms(ours, size)}"]]
    rows += [[name, _ms(theirs[name], size)] for name in THEIRS]
    rows += [["both of them", _ms(both, size)]]
    quartiles = f"{ratios[len(ratios) // 4]:.2f} to {ratios[3 * len(ratios) // 4]:.2f}"
    return [
        *rows,
        ["ratio, ours / both (quartiles)", f"{statistics.median(ratios):.2f} ({quartiles})"],
    ]


def _ms(taken: list[float], size: int) -> str:
    return f"{1000 * statistics.median(taken) / size:.1f}"


def rigs(data: str, frames: int, count: int) -> list[str]:
    """Cameras, and median and longest seconds of a calibration from ``frames`` frames."""
    pairs = draws(data, frames, count)
    calibration = build(
        configuration("test")["camera_baselines"]["rig"]["calibration"], "calibration"
    )
    taken = []
    succeeded = 0
    for draw in range(count):
        batch = pairs[[draw * len(pairs.pairs)]].observations
        names = list(pairs.rigs[0].names)
        arrays = (x[0].transpose(0, 1) for x in (batch.key_points, batch.confidence, batch.valid))
        start = time.perf_counter()
        estimate = calibration(names, batch.K[0], *arrays, None, 0)
        taken.append(time.perf_counter() - start)
        succeeded += estimate.succeeded
    times = f"{statistics.median(taken):.1f}", f"{max(taken):.1f}"
    return [f"{len(names)} ({data})", str(frames), *times, f"{succeeded} of {count}"]


def main() -> None:
    wanted = settings(frames=80, batch=12, rounds=15, threads=2, rigs=3)
    warnings.simplefilter("ignore")
    torch.set_num_threads(wanted["threads"])
    rows = race(wanted["frames"], wanted["batch"], wanted["rounds"])
    show(machine(), [f"a pair of cameras, {wanted['frames']} frames", "ms"], rows)
    if wanted["rigs"]:
        rows = [rigs(data, wanted["frames"], wanted["rigs"]) for data in ("h36m", "panoptic")]
        show(machine(), ["cameras", "frames", "median, s", "longest, s", "without an error"], rows)


if __name__ == "__main__":
    main()
