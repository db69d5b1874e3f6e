"""Choose the numbers of the camera problem's classical baselines: ``python
scripts/tune_camera_baselines.py``.

Prints the median E_3D (mm, with the known length of t) of each estimator for each setting, for
every pair of cameras, over random draws of 80 frames of the synthetic Human3.6M's validation split
(S8), and the time for a pair. The geometric mean over the pairs decides, so that every pair counts
the same: conf/camera_baselines/default.yaml holds the best. Arguments, if any, are the estimators
to tune, and ``outliers=0.3`` moves so many of the key points by 0.1 to 0.5 of the person's size
(five_point was chosen without, and with 0.1 and 0.3). Test data are never looked at.
"""

import sys
import time
from dataclasses import replace
from pathlib import Path

import hydra
import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from ghpt.config import build, plain
from ghpt.data.datasets.pairs import Pairs, PairSettings
from ghpt.geometry.cameras import Cameras
from ghpt.metrics.relative_pose import error_3d
from ghpt.models.relative_pose.baselines import (
    EightPoint,
    FivePoint,
    PairBaseline,
    PoseLib,
    Ransac,
    Refined,
    Usac,
)
from ghpt.models.relative_pose.refinement import PoseRefinement
from ghpt.observations import Labelled, PairObservations, PairTruth, RelativePoseEstimate

CONF = Path(__file__).resolve().parents[1] / "conf"
DRAWS = 20
USAC = {"confidence": 0.9999, "iterations": 1000}
CANDIDATES: dict[str, dict[str, PairBaseline]] = {
    "eight_point": {"": EightPoint()},
    "ransac": {
        f"threshold {x}": Ransac(samples=500, threshold=x, seed=0)
        for x in (0.02, 0.03, 0.04, 0.06, 0.08)
    },
    **{
        f"usac_{method}": {
            f"threshold {x}, pixels {pixels}": Usac(
                f"USAC_{method.upper()}", threshold=x, pixels=pixels, **USAC
            )
            for pixels in (1.0, 100.0, 200.0, 500.0)
            for x in (0.01, 0.02, 0.04, 0.08)
        }
        for method in ("magsac", "accurate")
    },
    "poselib": {
        f"threshold {x}, {loss} {scale}": PoseLib(
            threshold=x, loss=loss, scale=scale, iterations=1000, seed=0
        )
        for x in (0.01, 0.02, 0.04)
        for loss in ("TRUNCATED", "HUBER", "CAUCHY")
        for scale in (0.003, 0.006, 0.012)
    },
    "five_point": {
        f"kernel {kernel}, trim {trim}": Refined(
            FivePoint(samples=100, threshold=0.02, seed=0),
            PoseRefinement(kernel=kernel, trim=trim, rounds=12),
        )
        for kernel in (3.0, 4.0, 6.0)
        for trim in (3.0, 4.0)
    },
}


def validation_pairs() -> Labelled[PairObservations, PairTruth]:
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        config = plain(
            hydra.compose("train", ["data=h36m", "data.evaluate=validation", "output=none"])
        )
    data = build(config["data"], "data")
    data.setup("test")
    pairs = Pairs(
        data.frames["test"].recordings, PairSettings(frames=80, draws=DRAWS, points=500), seed=0
    )
    return pairs[range(len(pairs))]


def with_outliers(batch: PairObservations, rate: float) -> PairObservations:
    """Return the batch with this share of its key points moved in random directions."""
    generator = torch.Generator().manual_seed(0)
    points = batch.key_points.double()
    shape = points.shape[:-1]
    moved = torch.rand(shape, generator=generator) < rate
    size = (points.amax(-2) - points.amin(-2)).norm(dim=-1)[..., None]
    angle = 2 * torch.pi * torch.rand(shape, generator=generator, dtype=points.dtype)
    length = size * (0.1 + 0.4 * torch.rand(shape, generator=generator, dtype=points.dtype))
    step = moved[..., None] * length[..., None] * torch.stack((angle.cos(), angle.sin()), dim=-1)
    return replace(batch, key_points=(points + step).to(batch.key_points))


def errors(estimate: RelativePoseEstimate, pairs: PairTruth) -> Tensor:
    """E_3D of each pair, mean over the points; inf where there is no pose."""
    truth = pairs.cameras
    (Ra, Rb), (ta, tb) = truth.R.unbind(1), truth.t.unbind(1)
    length = (tb - (Rb @ Ra.mT @ ta[..., None])[..., 0]).norm(dim=-1, keepdim=True)
    R = torch.stack((Ra, estimate.R @ Ra), dim=1)
    t = torch.stack((ta, (estimate.R @ ta[..., None])[..., 0] + length * estimate.t), dim=1)
    error, counted = error_3d(Cameras(truth.K, R, t), truth, pairs.points)
    mean = torch.where(counted, error, 0.0).sum(-1) / counted.sum(-1)
    return torch.where(estimate.estimated & (counted.sum(-1) > 0), mean, torch.inf)


def main() -> None:
    torch.set_num_threads(1)
    labelled = validation_pairs()
    options = [word for word in sys.argv[1:] if word.startswith("outliers=")]
    names_given = [word for word in sys.argv[1:] if word not in options]
    rate = float(options[-1].partition("=")[2]) if options else 0.0
    batch = with_outliers(labelled.observations, rate)
    names = ["-".join(str(v + 1) for v in pair) for pair in batch.pair.tolist()]
    pairs = list(dict.fromkeys(names))
    for name in names_given or CANDIDATES:
        table = Table(
            name,
            *pairs,
            "all",
            "geometric",
            "ms",
            title=f"{name}: median E_3D, mm, {DRAWS} draws of S8",
        )
        rows = {}
        for setting, baseline in CANDIDATES[name].items():
            start = time.perf_counter()
            estimate = baseline(batch)
            duration = 1e3 * (time.perf_counter() - start) / len(batch)
            error = errors(estimate, labelled.truth)
            of_pair = torch.stack([error[[n == pair for n in names]].median() for pair in pairs])
            rows[setting] = (
                *of_pair.tolist(),
                error.median().item(),
                of_pair.log().mean().exp().item(),
                duration,
            )
        for setting, row in sorted(rows.items(), key=lambda item: item[1][-2]):
            table.add_row(setting, *(f"{x:.2f}" for x in row))
        Console(width=140).print(table)


if __name__ == "__main__":
    main()
