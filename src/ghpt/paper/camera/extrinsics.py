"""The actions of poses from estimated cameras (appendix A).

One estimates extrinsics from draws of frames, the other the poses that they give.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ghpt.config import Target, build, settings
from ghpt.data.datasets.frames import Frames
from ghpt.data.datasets.pairs import Pairs, PairSettings
from ghpt.errors import GhptDataError
from ghpt.files import write_json
from ghpt.geometry.cameras import Cameras
from ghpt.metrics.pose_error import MPJPE, Kind
from ghpt.models.checkpoint import LAST, load_model
from ghpt.models.module import StochasticEstimator
from ghpt.models.relative_pose.evaluation import camera_after
from ghpt.observations import PairObservations, RelativePoseEstimate
from ghpt.paper.engine.tasks import read_json
from ghpt.skeleton import JOINTS

PARTS = ("R", "t", "both")
"""Which of a relative pose's rotation and translation is the estimated one."""
KINDS: tuple[Kind, ...] = ("relative", "absolute")
HINT = "Draw more frames: sizes.unknown_extrinsics.frames."

Extrinsics = tuple[Float[Tensor, "V 3 3"], Float[Tensor, "V 3"]]
"""Each camera after the first, ``x_i = R x_1 + t``; mm."""
Estimator = Callable[[PairObservations, Cameras], Extrinsics]
"""From a draw's pairs, and the true cameras of its rig, of which it takes the scale alone."""


@dataclass(frozen=True)
class StoredExtrinsics:
    """The cameras after the first of one draw, as lists."""

    R: list[list[list[float]]]
    t: list[list[float]]
    """mm."""

    @classmethod
    def from_extrinsics(cls, extrinsics: Extrinsics) -> StoredExtrinsics:
        R, t = extrinsics
        return cls(R.tolist(), t.tolist())

    @property
    def extrinsics(self) -> Extrinsics:
        R = torch.tensor(self.R, dtype=torch.float64)
        t = torch.tensor(self.t, dtype=torch.float64)
        return R, t


@dataclass(frozen=True)
class RigDraws:
    """The estimates of one rig; result.json is a list of these."""

    recordings: list[int]
    """Indices of the rig's recordings."""
    draws: list[StoredExtrinsics]


def relative_poses(cameras: Cameras) -> Extrinsics:
    """Return the cameras as poses after the first one."""
    return cameras.relative_pose(0, slice(None))


def replace_part(truth: Cameras, estimate: Extrinsics, part: str) -> Cameras:
    """Return the true cameras with the estimated relative rotations, translations or both.

    ``part`` is one of ``PARTS``. The first camera is as it was.
    """
    R, t = relative_poses(truth)
    if part in ("R", "both"):
        R = estimate[0]
    if part in ("t", "both"):
        t = estimate[1]
    reference = truth.index((slice(0, 1),))
    return Cameras(truth.K, *camera_after(reference, R, t))


def with_true_scale(cameras: Cameras, truth: Cameras) -> Extrinsics:
    """Return a rig's relative poses at the true scale.

    The scale is the median ratio of true to estimated distances between cameras.
    """
    R, t = relative_poses(cameras)
    ratios = torch.pdist(truth.centre) / torch.pdist(cameras.centre)
    return R, t * ratios.median()


def poses_of_pairs(
    estimate: RelativePoseEstimate, batch: PairObservations, name: str
) -> Extrinsics:
    """Return the poses of the pairs (1, i), in their order, after the first camera's own.

    Raises GhptDataError where a pair has no estimate.
    """
    rows = torch.nonzero(batch.pair[:, 0] == 0)[:, 0]
    if not estimate.estimated[rows].all():
        raise GhptDataError(f"draw {int(batch.draw[0])}", name, "a pair has no estimate", HINT)
    identity = torch.eye(3, dtype=torch.float64)[None]
    zero = torch.zeros(1, 3, dtype=torch.float64)
    R = torch.cat((identity, estimate.R[rows].double()))
    t = torch.cat((zero, estimate.t[rows].double()))
    return R, t


@dataclass(frozen=True)
class LearnedPairs:
    """The weighted selection of a camera model, pair by pair."""

    model: StochasticEstimator

    def __call__(self, batch: PairObservations, truth: Cameras) -> Extrinsics:
        return poses_of_pairs(self.model.sample(batch, "test").estimate(), batch, "weight")


@dataclass(frozen=True)
class ClassicalPairs:
    """A classical estimator pair by pair; ``scale`` gives a pair's t its length."""

    estimator: Callable[[PairObservations], RelativePoseEstimate]
    scale: Callable[[RelativePoseEstimate, PairObservations], Tensor]
    name: str

    def __call__(self, batch: PairObservations, truth: Cameras) -> Extrinsics:
        pose = self.estimator(batch)
        length = self.scale(pose, batch)[..., None]
        return poses_of_pairs(replace(pose, t=pose.t * length), batch, self.name)


@dataclass(frozen=True)
class WholeRig:
    """All views of a draw calibrated together; the one scale is the true one."""

    calibration: Any

    def __call__(self, batch: PairObservations, truth: Cameras) -> Extrinsics:
        draw = int(batch.draw[0])
        names = [str(view) for view in range(len(truth.K))]
        arrays = (batch.key_points, batch.confidence, batch.valid)
        by_frame = [array[0].transpose(0, 1) for array in arrays]
        rig = self.calibration(names, truth.K, *by_frame, None, draw)
        if not rig.calibrated.all():
            raise GhptDataError(f"draw {draw}", "rig", "a camera is not calibrated", HINT)
        return with_true_scale(rig.cameras, truth)


@dataclass(frozen=True)
class ExtrinsicsSettings:
    """The settings of `estimate_extrinsics`."""

    data: Target
    source: str
    """``weight``, the camera model of the dependency ``model``, ``rig``, or a classical name."""
    frames: int
    """Frames of a draw."""
    draws: int
    """Draws of each rig."""
    seed: int
    hypotheses: int | None
    estimator: Target | None = None
    """What estimates where the source is not ``weight``."""
    scale: Target | None = None
    """What gives the t of a pair its length where the source is a classical estimator."""
    files: Mapping[str, Any] = field(default_factory=dict)
    """What identifies the files of a real data set."""


@torch.no_grad()
def estimate_extrinsics(
    config: dict[str, Any], dependencies: dict[str, Path], folder: Path
) -> None:
    """Estimate extrinsics from draws of frames of each rig; see `ExtrinsicsSettings`.

    result.json: a list of `RigDraws`.
    """
    own = settings(ExtrinsicsSettings, config)
    data = build(own.data, "data")
    recordings = data.recordings(data.evaluate)
    pairs = Pairs(recordings, PairSettings(own.frames, own.draws, 1), own.seed)
    pairs.pairs = [pair for pair in pairs.pairs if pair[0] == 0]
    estimator = _build_estimator(own, dependencies)
    stored: list[list[StoredExtrinsics]] = [[] for _ in pairs.rigs]
    for draw in range(len(pairs.rigs) * own.draws):
        rig = draw // own.draws
        rows = range(draw * len(pairs.pairs), (draw + 1) * len(pairs.pairs))
        extrinsics = estimator(pairs[rows].observations, pairs.rigs[rig].cameras)
        stored[rig].append(StoredExtrinsics.from_extrinsics(extrinsics))
    rigs = [
        RigDraws(list(rig.recordings), of_rig)
        for rig, of_rig in zip(pairs.rigs, stored, strict=True)
    ]
    write_json(folder / "result.json", [asdict(rig) for rig in rigs])


def _build_estimator(own: ExtrinsicsSettings, dependencies: Mapping[str, Path]) -> Estimator:
    if own.source == "weight":
        changes: dict[str, Any] = {
            "seed": own.seed,
            "hypotheses": own.hypotheses,
            "problem.frames": own.frames,
        }
        return LearnedPairs(load_model(dependencies["model"] / LAST, **changes)[0].eval())
    estimator = build(own.estimator, "estimator")
    if own.source == "rig":
        return WholeRig(estimator)
    return ClassicalPairs(estimator, build(own.scale, "scale"), own.source)


@dataclass(frozen=True)
class PosesSettings:
    """The settings of `poses_from_extrinsics`."""

    data: Target
    seed: int
    hypotheses: int | None
    parts: Sequence[str] = ()
    """Which parts of the estimated extrinsics are tested, of ``PARTS``."""
    files: Mapping[str, Any] = field(default_factory=dict)
    """What identifies the files of a real data set."""


def poses_from_extrinsics(
    config: dict[str, Any], dependencies: dict[str, Path], folder: Path
) -> None:
    """Test the pose model of the dependency ``model`` with some parts of estimated extrinsics.

    They are those of the dependency ``extrinsics``; where there is none, the true ones are used.
    result.json: part of ``PARTS`` (or ``known``) -> kind -> MPJPE (mm) of ``weight``.
    """
    own = settings(PosesSettings, config)
    changes: dict[str, Any] = {"seed": own.seed, "hypotheses": own.hypotheses}
    model = load_model(dependencies["model"] / LAST, **changes)[0].eval()
    data = build(own.data, "data")
    data.setup("test")
    true_frames = data.frames["test"]
    frames = {"known": true_frames}
    if "extrinsics" in dependencies:
        contents = read_json(dependencies["extrinsics"] / "result.json")
        rigs = [settings(RigDraws, content) for content in contents]
        frames = {part: through_draws(true_frames, rigs, part) for part in own.parts}
    errors = {
        part: pose_errors(model, of_part, data.batch_size) for part, of_part in frames.items()
    }
    write_json(folder / "result.json", errors)


def through_draws(frames: Frames, rigs: Sequence[RigDraws], part: str) -> Frames:
    """Return the frames, each with some part of the cameras from one draw.

    The draws take turns, so that all of them cost one test.
    """
    draws = len(rigs[0].draws)
    recordings = []
    for draw in range(draws):
        estimates = {index: rig.draws[draw].extrinsics for rig in rigs for index in rig.recordings}
        for index, recording in enumerate(frames.recordings):
            cameras = replace_part(recording.cameras, estimates[index], part)
            recordings.append(replace(recording, cameras=cameras))
    turn = np.arange(len(frames)) % draws
    return Frames(recordings, frames.frames + turn * frames.start[-1])


@torch.no_grad()
def pose_errors(model: StochasticEstimator, frames: Frames, batch_size: int) -> dict[str, float]:
    """Return the MPJPE (mm) of the weighted selection over the frames, by kind."""
    metrics = {kind: MPJPE(kind, 1, len(JOINTS)) for kind in KINDS}
    for first in range(0, len(frames), batch_size):
        batch = frames[range(first, min(first + batch_size, len(frames)))]
        estimate = model.sample(batch.observations, "test").estimate()
        group = torch.zeros_like(batch.observations.index)
        for metric in metrics.values():
            metric.update(estimate, batch.truth, group)
    return {str(kind): metric.compute().mean.item() for kind, metric in metrics.items()}
