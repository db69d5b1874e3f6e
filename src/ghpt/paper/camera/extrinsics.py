"""The work of poses from estimated cameras (appendix A): extrinsics from draws of frames, and the
poses they give.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ghpt.config import build
from ghpt.data.datasets.frames import Frames
from ghpt.data.datasets.pairs import Pairs, PairSettings
from ghpt.errors import GhptDataError
from ghpt.files import write_json
from ghpt.geometry.cameras import Cameras
from ghpt.metrics.pose_error import MPJPE
from ghpt.models.checkpoint import LAST, load_model
from ghpt.models.module import StochasticEstimator
from ghpt.models.relative_pose.evaluation import camera_after
from ghpt.observations import PairObservations, RelativePoseEstimate
from ghpt.paper.engine.tasks import read_json
from ghpt.skeleton import JOINTS

PARTS = {"R": (True, False), "t": (False, True), "both": (True, True)}
"""Which of a relative pose's rotation and translation is the estimated one."""
KINDS = ("relative", "absolute")
HINT = "Draw more frames: sizes.unknown_extrinsics.frames."

Extrinsics = tuple[Float[Tensor, "V 3 3"], Float[Tensor, "V 3"]]
"""Each camera after the first, ``x_i = R x_1 + t``; mm."""


def relative(cameras: Cameras) -> Extrinsics:
    """The cameras as poses after the first one."""
    return cameras.relative_pose(0, slice(None))


def replaced(truth: Cameras, estimate: Extrinsics, use_R: bool, use_t: bool) -> Cameras:
    """The true cameras with the estimated relative rotations, translations or both; the first
    camera is as it was.
    """
    (true_R, true_t) = relative(truth)
    (R, t) = estimate
    reference = truth.index((slice(0, 1),))
    return Cameras(
        truth.K, *camera_after(reference, R if use_R else true_R, t if use_t else true_t)
    )


def with_true_scale(cameras: Cameras, truth: Cameras) -> Extrinsics:
    """A rig's relative poses times one number, the median ratio of true to estimated distances
    between cameras.
    """
    R, t = relative(cameras)
    return R, t * (torch.pdist(truth.centre) / torch.pdist(cameras.centre)).median()


def from_pairs(estimate: RelativePoseEstimate, batch: PairObservations, name: str) -> Extrinsics:
    """The poses of the pairs (1, i), in their order, and the first camera's own."""
    rows = torch.nonzero(batch.pair[:, 0] == 0)[:, 0]
    if not estimate.estimated[rows].all():
        raise GhptDataError(f"draw {int(batch.draw[0])}", name, "a pair has no estimate", HINT)
    eye = torch.eye(3, dtype=torch.float64)[None]
    zero = torch.zeros(1, 3, dtype=torch.float64)
    return torch.cat((eye, estimate.R[rows].double())), torch.cat((zero, estimate.t[rows].double()))


def from_rig(calibration: Any, batch: PairObservations, truth: Cameras) -> Extrinsics:
    """All views of a draw calibrated together; the one scale is the true one."""
    draw = int(batch.draw[0])
    arrays = (x[0].transpose(0, 1) for x in (batch.key_points, batch.confidence, batch.valid))
    found = calibration([str(view) for view in range(len(truth.K))], truth.K, *arrays, None, draw)
    if not found.calibrated.all():
        raise GhptDataError(f"draw {draw}", "rig", "a camera is not calibrated", HINT)
    return with_true_scale(found.cameras, truth)


@torch.no_grad()
def estimate_extrinsics(
    config: dict[str, Any], dependencies: dict[str, Path], folder: Path
) -> None:
    """Extrinsics from ``draws`` draws of ``frames`` frames of each rig, by ``source``: ``weight``,
    the camera model of ``dependencies["model"]``; ``rig``; or one of the pairs' classical estimators. What
    is not ``weight`` is built from ``estimator``, and a pair's t gets its length from ``scale``.

    result.json: for each rig the numbers of its recordings, and R and t (mm) of its cameras after
    the first in each draw.
    """
    source = config["source"]
    draws = config["draws"]
    data = build(config["data"], "data")
    pairs = Pairs(
        data.recordings(data.evaluate), PairSettings(config["frames"], draws, 1), config["seed"]
    )
    pairs.pairs = [pair for pair in pairs.pairs if pair[0] == 0]
    if source == "weight":
        changes = {
            "seed": config["seed"],
            "hypotheses": config["hypotheses"],
            "problem.frames": config["frames"],
        }
        model = load_model(dependencies["model"] / LAST, **changes)[0].eval()
    else:
        estimator = build(config["estimator"], "estimator")
        scale = build(config["scale"], "scale")
    found: list[list[list[Any]]] = [[] for _ in pairs.rigs]
    for draw in range(len(pairs.rigs) * draws):
        rows = range(draw * len(pairs.pairs), (draw + 1) * len(pairs.pairs))
        batch = pairs[rows].observations
        if source == "weight":
            extrinsics = from_pairs(model.sample(batch, "test").estimate(), batch, source)
        elif source == "rig":
            extrinsics = from_rig(estimator, batch, pairs.rigs[draw // draws].cameras)
        else:
            pose = estimator(batch)
            extrinsics = from_pairs(
                replace(pose, t=pose.t * scale(pose, batch)[..., None]), batch, source
            )
        found[draw // draws].append([x.tolist() for x in extrinsics])
    rigs = [
        {"recordings": list(r.recordings), "draws": d}
        for r, d in zip(pairs.rigs, found, strict=True)
    ]
    write_json(folder / "result.json", rigs)


def poses_from_extrinsics(
    config: dict[str, Any], dependencies: dict[str, Path], folder: Path
) -> None:
    """Test the pose model of ``dependencies["model"]`` with some ``parts`` of the extrinsics from
    ``dependencies["extrinsics"]``, or where there are none with the true ones.

    result.json: part of `PARTS` (or ``known``) -> kind -> MPJPE (mm) of ``weight``.
    """
    changes = {"seed": config["seed"], "hypotheses": config["hypotheses"]}
    model = load_model(dependencies["model"] / LAST, **changes)[0].eval()
    data = build(config["data"], "data")
    data.setup("test")
    frames = {"known": data.frames["test"]}
    if "extrinsics" in dependencies:
        rigs = read_json(dependencies["extrinsics"] / "result.json")
        frames = {
            part: seen_by(data.frames["test"], rigs, *PARTS[part]) for part in config["parts"]
        }
    write_json(
        folder / "result.json",
        {part: pose_errors(model, f, data.batch_size) for part, f in frames.items()},
    )


def seen_by(frames: Frames, rigs: Sequence[Mapping[str, Any]], use_R: bool, use_t: bool) -> Frames:
    """The frames, each through the cameras of one draw; the draws take turns, so that all of them
    cost one test.
    """
    draws = len(rigs[0]["draws"])
    recordings = []
    for draw in range(draws):
        estimates = {index: rig["draws"][draw] for rig in rigs for index in rig["recordings"]}
        for index, recording in enumerate(frames.recordings):
            R, t = (torch.tensor(x, dtype=torch.float64) for x in estimates[index])
            recordings.append(
                replace(recording, cameras=replaced(recording.cameras, (R, t), use_R, use_t))
            )
    turn = np.arange(len(frames)) % draws
    return Frames(recordings, frames.frames + turn * frames.start[-1])


@torch.no_grad()
def pose_errors(model: StochasticEstimator, frames: Frames, batch_size: int) -> dict[str, float]:
    """MPJPE (mm) of the weighted selection over the frames, by kind."""
    metrics = {kind: MPJPE(kind, 1, len(JOINTS)) for kind in KINDS}
    for first in range(0, len(frames), batch_size):
        batch = frames[range(first, min(first + batch_size, len(frames)))]
        estimate = model.sample(batch.observations, "test").estimate()
        for metric in metrics.values():
            metric.update(estimate, batch.truth, torch.zeros_like(batch.observations.index))
    return {kind: metric.compute().mean.item() for kind, metric in metrics.items()}
