"""Predictions of the camera problem on a ring of cameras, made by hand, for tests of its report."""

from collections.abc import Mapping
from itertools import combinations
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ghpt.data.datasets.pairs import RigOfSplit
from ghpt.geometry.cameras import Cameras
from ghpt.models.aggregation import WeightSummary
from ghpt.models.predictions import PredictionWriter, open_predictions
from ghpt.models.relative_pose.schema import PAIRS, PairPredictions, PairSample, RigTables
from ghpt.observations import RelativePoseEstimate
from scenes import look_at

META = {
    "data": "h36m",
    "source": "synthetic",
    "split": "test",
    "seed": 7,
    "hypotheses": 5,
    "frames": 80,
    "provenance": {
        "commit": "abc",
        "checkpoint": "last.ckpt",
        "training": {"data": "h36m", "source": "synthetic"},
    },
}
NAMES = ("weight", "average", "worst", "eight_point", "poselib", "rig")


def rig(seed: int, views: int = 4) -> RigOfSplit:
    """Cameras on a ring of 5 m that look at the middle, 1.5 m above the ground, z up."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * np.arange(views) / views + rng.normal(0, 0.1, views)
    centre = np.stack((5000 * np.cos(angle), 5000 * np.sin(angle), np.full(views, 1500.0)), axis=-1)
    R = look_at(centre, rng.normal([0, 0, 900], 150, (views, 3)), np.tile([0.0, 0, -1], (views, 1)))
    K = np.tile([[1145.0, 0, 512], [0, 1143, 515], [0, 0, 1]], (views, 1, 1))
    cameras = Cameras(*(torch.from_numpy(x) for x in (K, R, -(R @ centre[..., None])[..., 0])))
    points = torch.from_numpy(rng.uniform([-1200, -1200, 0], [1200, 1200, 1900], (50, 3)))
    return RigOfSplit(f"S{seed}", tuple(f"c{i}" for i in range(views)), cameras, (0,), points)


def true_poses(
    rigs: list[RigOfSplit], index: torch.Tensor, pair: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """The relative poses of pairs of views."""
    poses = []
    for which, (a, b) in zip(index.tolist(), pair.tolist(), strict=True):
        c = rigs[which].cameras
        R = c.R[b] @ c.R[a].T
        poses.append((R, c.t[b] - R @ c.t[a]))
    return torch.stack([R for R, _ in poses]), torch.stack([t for _, t in poses])


def moved(
    poses: tuple[torch.Tensor, torch.Tensor],
    degrees: float,
    mm: float,
    seed: int,
    missing: float = 0.0,
) -> RelativePoseEstimate:
    """Poses turned by about ``degrees`` and shifted by about ``mm``; a share of them missing."""
    rng = np.random.default_rng(seed)
    count = len(poses[0])
    turn = Rotation.from_rotvec(
        np.deg2rad(degrees) * rng.normal(0, 3**-0.5, (count, 3))
    ).as_matrix()
    R, t = (
        torch.from_numpy(turn) @ poses[0],
        poses[1] + torch.from_numpy(rng.normal(0, mm / 3**0.5, (count, 3))),
    )
    estimated = torch.from_numpy(rng.random(count) >= missing)
    R = torch.where(estimated[:, None, None], R, torch.eye(3, dtype=torch.float64))
    return RelativePoseEstimate(R, torch.where(estimated[:, None], t, 0.0), estimated)


def content(rigs: list[RigOfSplit], draws: int = 10) -> dict:
    """What a predictions file is of: all pairs of ``draws`` draws of each rig."""
    pairs = list(combinations(range(len(rigs[0].names)), 2))
    each = [
        (g, g * draws + d, pair) for g in range(len(rigs)) for d in range(draws) for pair in pairs
    ]
    index, draw = (torch.tensor([row[i] for row in each]) for i in (0, 1))
    pair = torch.tensor([row[2] for row in each])
    truth = true_poses(rigs, index, pair)
    estimates = {
        name: moved(
            truth, 0.1 * (i + 1), 5.0 * (i + 1), seed=i, missing=0.2 if name == "poselib" else 0.0
        )
        for i, name in enumerate(NAMES)
    }
    summary = torch.linspace(0, 1, len(each))
    weights = WeightSummary(summary, summary, summary)
    return {
        "estimates": estimates,
        "truth": truth,
        "rig": index,
        "draw": draw,
        "pair": pair,
        "weights": weights,
    }


def written(
    folder: Path, rigs: list[RigOfSplit], values: Mapping, meta: Mapping = META
) -> PairPredictions:
    """The content through a predictions file."""
    names = tuple(values["estimates"])
    writer = PredictionWriter(folder / "rows", len(values["draw"]), names, PAIRS)
    for rows in torch.arange(len(values["draw"])).split(7):
        write_rows(writer, rows, values)
    writer.finish(folder / "predictions.npz", RigTables.from_rigs(rigs), meta)
    return open_predictions(folder / "predictions.npz", PAIRS)


def write_rows(writer: PredictionWriter, rows: torch.Tensor, values: Mapping) -> None:
    """Write some of the rows of the content."""
    R, t = values["truth"]
    sample = PairSample(R, t, values["rig"], values["draw"], values["pair"])
    estimates = {name: estimate.rows(rows) for name, estimate in values["estimates"].items()}
    writer.write(rows, estimates, sample.rows(rows), values["weights"].rows(rows))
