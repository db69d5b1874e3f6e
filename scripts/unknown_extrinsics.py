"""Poses from estimated cameras (appendix A, tab:unknown-extrinsics-evaluation), on the embedded (synthetic) Human3.6M.

``python scripts/unknown_extrinsics.py`` tests a pose model trained on Human3.6M and one trained on CMU3 (runs/h36m,
runs/cmu3; trained if they are not there) with the true extrinsics, and with extrinsics estimated from M frames of each
rig: rotations alone, translations alone, both. They come from the camera model (runs/camera) and from PoseLib, pair
(1, i) by pair with the true length of t, as in the paper; and from the calibration of the whole rig, whose one scale is
the median ratio of true to estimated distances between cameras. Camera 1 is the true one in all of them. Finished parts
are kept in runs/unknown_extrinsics, in a folder of the checkpoints' content and the settings.
"""

import argparse
import hashlib
import json
import logging
import statistics
import warnings
from dataclasses import replace
from pathlib import Path

import hydra
import torch
from jaxtyping import Float
from torch import Tensor

from ghpt.config import build, plain
from ghpt.data.frames import Frames
from ghpt.data.pairs import Pairs, PairSettings
from ghpt.errors import GhptDataError
from ghpt.files import atomic_write
from ghpt.geometry.cameras import Cameras
from ghpt.metrics.pose_error import MPJPE
from ghpt.models.checkpoint import load_model
from ghpt.models.module import StochasticEstimator
from ghpt.recording import PairBatch, Recording, RelativePoseEstimate
from ghpt.report.pair_evaluate import camera_after
from ghpt.report.tables import markdown
from ghpt.skeleton import JOINTS
from ghpt.train import train

ROOT = Path(__file__).resolve().parents[1]
NAMES = {"h36m": "base", "cmu3": "CMU3 → H36M"}
PAPER = {"h36m": (29.1, 29.4, 36.7, 37.3), "cmu3": (31.0, 33.6, 42.2, 44.5)}
"""tab:unknown-extrinsics-evaluation: known, estimated R, estimated t, both; mm."""
SOURCES = {"weight": "pairs, learned", "poselib": "pairs, PoseLib", "rig": "rig"}
PARTS = {"R": (True, False), "t": (False, True), "both": (True, True)}
"""Which of a relative pose's rotation and translation is the estimated one."""
BASELINES = ("m_estimator", "linear", "ransac")
KINDS = ("relative", "absolute")

Extrinsics = tuple[Float[Tensor, "V 3 3"], Float[Tensor, "V 3"]]
"""Each camera after the first, ``x_i = R x_1 + t``; mm."""
Errors = dict[str, dict[str, float]]
"""Training set of the model, or baseline -> kind -> MPJPE, mm."""


def relative(cameras: Cameras) -> Extrinsics:
    """The cameras as poses after the first one."""
    R = cameras.R @ cameras.R[0].mT
    return R, cameras.t - (R @ cameras.t[0, :, None])[..., 0]


def replaced(truth: Cameras, estimate: Extrinsics, use_R: bool, use_t: bool) -> Cameras:
    """The true cameras with the estimated relative rotations, translations or both; the first camera is as it was."""
    (true_R, true_t), (R, t) = relative(truth), estimate
    reference = truth.index((slice(0, 1),))
    return Cameras(truth.K, *camera_after(reference, R if use_R else true_R, t if use_t else true_t))


def with_true_scale(cameras: Cameras, truth: Cameras) -> Extrinsics:
    """A rig's relative poses times one number, the median ratio of true to estimated distances between cameras."""
    R, t = relative(cameras)
    return R, t * (torch.pdist(truth.centre) / torch.pdist(cameras.centre)).median()


def from_pairs(estimate: RelativePoseEstimate, batch: PairBatch, name: str) -> Extrinsics:
    """The poses of the pairs (1, i), in their order, and the first camera's own."""
    rows = torch.nonzero(batch.pair[:, 0] == 0)[:, 0]
    if not estimate.estimated[rows].all():
        raise GhptDataError(f"draw {int(batch.draw[0])}", name, "a pair has no estimate", "Draw more frames.")
    eye, zero = torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 3, dtype=torch.float64)
    return torch.cat((eye, estimate.R[rows].double())), torch.cat((zero, estimate.t[rows].double()))


@torch.no_grad()
def pose_errors(estimators: dict, frames: Frames) -> Errors:
    """MPJPE of the models' weighted selections and of the baselines over the frames."""
    metrics = {name: {kind: MPJPE(kind, 1, len(JOINTS)) for kind in KINDS} for name in estimators}
    for first in range(0, len(frames), 16):
        batch = frames[range(first, min(first + 16, len(frames)))]
        for name, estimator in estimators.items():
            model = isinstance(estimator, StochasticEstimator)
            estimate = estimator.test_step(batch, 0)[0]["weight"] if model else estimator(batch)
            for metric in metrics[name].values():
                metric.update(estimate, batch.truth, batch.truth_seen, torch.zeros_like(batch.sample))
    return {name: {kind: m.compute().mean.item() for kind, m in each.items()} for name, each in metrics.items()}


class Experiment:
    """The recordings, the estimators, and the folder of what is finished."""

    def __init__(self, camera: Path, poses: dict[str, Path], draws: int, frames: int, stride: int) -> None:
        content = hashlib.sha256(repr((frames, stride)).encode() + b"".join(p.read_bytes() for p in poses.values()))
        self.folder, self.draws = ROOT / "runs" / "unknown_extrinsics" / content.hexdigest()[:12], draws
        self.camera_digest = hashlib.sha256(camera.read_bytes()).hexdigest()[:12]
        config = compose("test", ["data=h36m", f"data.stride={stride}"])
        data = build(config["data"], "data")
        data.setup("test")
        self.frames = data.frames["test"]
        self.pairs = {
            subject: Pairs(
                [r for r in self.frames.recordings if r.subject == subject], PairSettings(frames, draws, 1), i
            )
            for i, subject in enumerate(dict.fromkeys(r.subject for r in self.frames.recordings))
        }
        self.camera = load_model(camera, **{"problem.frames": frames})[0].eval()
        self.poselib = build(config["camera_baselines"]["poselib"], "camera_baselines")
        self.rig = build(config["camera_baselines"]["rig"]["calibration"], "calibration")
        models = {name: load_model(path)[0].eval() for name, path in poses.items()}
        self.estimators = models | {name: build(config["baselines"][name], "baselines") for name in BASELINES}

    @torch.no_grad()
    def estimate(self, source: str, subject: str, draw: int) -> Extrinsics:
        """From one draw of frames of one rig."""
        pairs = self.pairs[subject]
        batch = pairs[range(draw * len(pairs.pairs), (draw + 1) * len(pairs.pairs))]
        if source == "weight":
            return from_pairs(self.camera.test_step(batch, 0)[0]["weight"], batch, source)
        if source == "poselib":
            found = self.poselib(batch)
            found = replace(found, t=found.t * self.camera.problem.scale(found, batch)[..., None])
            return from_pairs(found, batch, source)
        truth = batch.cameras.index(0)
        arrays = (x[0].transpose(0, 1) for x in (batch.key_points, batch.confidence, batch.seen))
        calibrated = self.rig([str(view) for view in range(len(truth.K))], truth.K, *arrays, None, draw)
        if not calibrated.calibrated.all():
            raise GhptDataError(f"{subject}, draw {draw}", source, "a camera is not calibrated", "Draw more frames.")
        return with_true_scale(calibrated.cameras, truth)

    def extrinsics(self, source: str, draw: int) -> dict[str, Extrinsics]:
        """Subject -> estimated extrinsics."""
        path = self.folder / f"{self._name(source)}-extrinsics-{draw}.json"
        if not path.exists():
            found = {subject: self.estimate(source, subject, draw) for subject in self.pairs}
            write(path, {subject: [x.tolist() for x in each] for subject, each in found.items()})
        stored = json.loads(path.read_text())
        return {subject: tuple(torch.tensor(x, dtype=torch.float64) for x in each) for subject, each in stored.items()}

    def _name(self, source: str) -> str:
        """In files: only one of the sources depends on the camera model."""
        return f"weight-{self.camera_digest}" if source == "weight" else source

    def errors(self, source: str, part: str, draw: int) -> Errors:
        """With a part of the extrinsics from ``source``; ``known`` has none."""
        path = self.folder / f"{self._name(source)}-{part}-{draw}.json"
        if not path.exists():
            recordings = self.frames.recordings
            if source != "known":
                found = self.extrinsics(source, draw)
                recordings = [seen_by(r, found[r.subject], *PARTS[part]) for r in recordings]
            write(path, pose_errors(self.estimators, Frames(recordings, self.frames.frames)))
        return json.loads(path.read_text())


def seen_by(recording: Recording, estimate: Extrinsics, use_R: bool, use_t: bool) -> Recording:
    """The recording with estimated cameras in place of its own."""
    return replace(recording, cameras=replaced(recording.cameras, estimate, use_R, use_t))


def table(experiment: Experiment, kind: str) -> str:
    """tab:unknown-extrinsics-evaluation: mean over the draws ± deviation, and the increase over known."""
    rows = []
    for estimator, words in (NAMES | {name: name for name in BASELINES}).items():
        known = experiment.errors("known", "none", 0)[estimator][kind]
        for source, name in SOURCES.items():
            cells = [f"{words}, {name}", f"{known:.1f}"]
            for part in PARTS:
                values = [experiment.errors(source, part, draw)[estimator][kind] for draw in range(experiment.draws)]
                mean, deviation = statistics.mean(values), statistics.stdev(values) if len(values) > 1 else 0.0
                cells.append(f"{mean:.1f} ± {deviation:.1f} ({100 * (mean / known - 1):+.1f} %)")
            rows.append(cells)
        if estimator in PAPER and kind == "relative":
            first, *paper = PAPER[estimator]
            cells = [f"{x:.1f} ({100 * (x / first - 1):+.1f} %)" for x in paper]
            rows.append([f"{words}, the paper on real data", f"{first:.1f}", *cells])
    return markdown(["cameras", "known", "estimated R", "estimated t", "estimated [R|t]"], rows)


def compose(name: str, overrides: list[str]) -> dict:
    with hydra.initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return plain(hydra.compose(name, [*overrides, "progress_bar=false", "output=unused"]))


def write(path: Path, content: dict) -> None:
    with atomic_write(path, "w") as handle:
        json.dump(content, handle)


def trained(name: str, overrides: list[str]) -> Path:
    """The checkpoint runs/<name>/last.ckpt, trained first where it is not there."""
    path = ROOT / "runs" / name / "last.ckpt"
    if not path.exists():
        train(compose("train", overrides), path.parent)
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=5, help="of M frames of each rig")
    parser.add_argument("--frames", type=int, default=80, help="M")
    parser.add_argument("--stride", type=int, default=64, help="every so many frames are tested")
    parser.add_argument("--camera", type=Path, help="checkpoint of the camera model (runs/camera/last.ckpt)")
    options = parser.parse_args()
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    warnings.simplefilter("ignore")
    camera = options.camera or trained("camera", ["data=h36m", "model=camera"])
    poses = {name: trained(name, [f"data={name}"]) for name in NAMES}
    experiment = Experiment(camera, poses, options.draws, options.frames, options.stride)
    about = f"cameras from {options.frames} frames; mean ± deviation over {options.draws} draws (increase over known)"
    for kind in KINDS:
        print(f"\n{kind} MPJPE in mm, embedded (synthetic) Human3.6M, {about}\n\n{table(experiment, kind)}", flush=True)


if __name__ == "__main__":
    main()
