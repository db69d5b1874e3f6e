"""What the weights that ship are worth beside every classical estimator of single frames.

    python benchmarks/learned.py [--frames 240] [--split test] [data=h36m ...]

Under each perturbation of the robustness curves (conf/reproduce.yaml) a row: the best classical
estimator, ``frame_learned``, which weighs key points, and the same with ``joints=joint``, which
scores joints on top: pelvis-relative MPJPE, mm, and the difference from the best classical one.
Words with ``=`` are those of test.py; ``data=panoptic`` has the curve over the number of cameras.
Ends with frames per second of processor time.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace

import hydra
import torch
import yaml

from ghpt.config import CONF, build, plain, settings
from ghpt.data.datasets.frames import Frames
from ghpt.metrics.pose_error import joint_errors
from ghpt.models.estimators.classical import Estimator
from ghpt.models.estimators.frame_learned import FrameLearned
from ghpt.observations import Labelled, Observations, PoseEstimate, Truth
from ghpt.paper.engine.settings import Robustness
from ghpt.paper.robustness.curve import PERTURBATIONS, Curve
from ghpt.paper.robustness.curves import ALL_CURVES
from ghpt.paper.robustness.perturbation import Perturbation

BATCH = 512
"""Frames at a time, as predict.py has them."""


def draw_frames(words: list[str], split: str, count: int) -> tuple[Frames, Mapping[str, Estimator]]:
    """Return so many frames, evenly spread, of a data set, and the estimators of conf/baselines."""
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        composed = hydra.compose("test", [*words, f"data.evaluate={split}", "output=unused"])
    config = plain(composed)
    data = build(config["data"], "data")
    data.setup("test")
    recordings = data.frames["test"].recordings
    total = sum(map(len, recordings))
    frames = Frames(recordings, torch.linspace(0, total - 1, count).long().numpy())
    return frames, build(config["baselines"], "baselines")


def conditions(data: str) -> Iterator[tuple[str, Perturbation | None]]:
    """Yield the name and the perturbation of each level of the curves of a data set."""
    text = (CONF / "reproduce.yaml").read_text(encoding="utf-8")
    sizes = settings(Robustness, yaml.safe_load(text)["sizes"]["robustness"])
    if data != "panoptic":
        yield "as it is", None
    for curve in ALL_CURVES:
        if (curve.data == "panoptic") == (data == "panoptic"):
            yield from levels(curve, sizes)


def levels(curve: Curve, sizes: Robustness) -> Iterator[tuple[str, Perturbation]]:
    """Yield the name and the perturbation of each level of a curve but the first, which is none."""
    for level in curve.levels_of(sizes):
        if level:
            target = f"{PERTURBATIONS}.{curve.perturbation}"
            node = {"_target_": target, curve.argument: level, **curve.constants_of(sizes)}
            yield f"{curve.x}: {curve.factor * level:g}", build(node, "perturbation")


def estimate(estimator: Estimator, observations: Observations) -> PoseEstimate:
    parts = []
    for first in range(0, len(observations), BATCH):
        parts.append(estimator(observations.rows(slice(first, first + BATCH))))
    points = torch.cat([part.points for part in parts])
    return PoseEstimate(points, torch.cat([part.estimated for part in parts]))


def mean_error(poses: PoseEstimate, truth: Truth) -> float:
    errors, counted = joint_errors(poses, truth, "relative")
    return float(errors[counted].mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", type=int, default=240)
    parser.add_argument("--split", default="test")
    parser.add_argument("words", nargs="*", default=["data=h36m"])
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    frames, estimators = draw_frames(arguments.words, arguments.split, arguments.frames)
    batch: Labelled[Observations, Truth] = frames[range(len(frames))]
    own = estimators["frame_learned"]
    if not isinstance(own, FrameLearned):
        raise TypeError("conf/baselines has no frame_learned")
    learned = {
        "key points": replace(own, joints=None),
        "with joints": replace(own, joints="joint"),
    }
    classical = {name: one for name, one in estimators.items() if name != "frame_learned"}
    print("| condition | best classical | key points | with joints |\n|" + "---|" * 4)
    data = next(word for word in arguments.words if word.startswith("data=")).removeprefix("data=")
    for name, perturbation in conditions(data):
        observations = replace(batch.observations, index=torch.from_numpy(frames.frames))
        if perturbation is not None:
            observations = perturbation(observations, 0)
        errors = {
            rival: mean_error(estimate(one, observations), batch.truth)
            for rival, one in classical.items()
        }
        best = min(errors, key=errors.__getitem__)
        cells = [f"{errors[best]:.2f} ({best})"]
        for one in learned.values():
            error = mean_error(estimate(one, observations), batch.truth)
            cells.append(f"{error:.2f} ({100 * (error / errors[best] - 1):+.1f} %)")
        print("|", " | ".join([name, *cells]), "|", flush=True)
    for name, one in (classical | learned).items():
        start = time.process_time()
        estimate(one, batch.observations)
        print(f"{len(frames) / (time.process_time() - start):.0f} frames/s: {name}")


if __name__ == "__main__":
    main()
