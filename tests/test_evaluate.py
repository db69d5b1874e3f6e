import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from ghpt.files import write_json
from ghpt.geometry.cameras import Cameras
from ghpt.models.aggregation import WeightSummary
from ghpt.models.pose.evaluation import NAMES, evaluate_poses
from ghpt.models.pose.schema import POSES, PoseSample, PoseTables
from ghpt.models.predictions import PredictionWriter, open_predictions, with_nan
from ghpt.observations import PoseEstimate, Recording, Truth
from ghpt.skeleton import JOINTS, PELVIS, SIX_JOINTS

TAKES = ("S9/Greeting-2", "S9/Greeting-1", "S11/Walking-1", "S11/Eating-1")
META = {
    "data": "h36m",
    "source": "synthetic",
    "split": "test",
    "seed": 7,
    "provenance": {"commit": "abc"},
}
MEANS = ("mpjpe_absolute", "mpjpe_relative", "mpjpe_aligned", "mpjpe_6_joints")


def recording(name: str) -> Recording:
    """A recording of no frames."""
    cameras = Cameras(torch.zeros(2, 3, 3), torch.zeros(2, 3, 3), torch.zeros(2, 3))
    views, mask = np.zeros((0, 2, 17, 2), np.float32), np.zeros((0, 2, 17), bool)
    subject, action = name.split("/")
    return Recording(
        name=name,
        subject=subject,
        action=action.split("-")[0],
        rate_hz=50.0,
        camera_names=("a", "b"),
        cameras=cameras,
        key_points=views,
        confidence=views[..., 0],
        valid=mask,
        frame=np.zeros(0, np.int64),
    )


def content(count: int = 60, takes: int = len(TAKES)) -> dict:
    g = torch.Generator().manual_seed(0)
    truth = 300 * torch.randn(count, 17, 3, generator=g)
    recording = torch.arange(count) % takes
    noise = torch.where(recording == 0, 100.0, 10.0)[:, None, None]
    estimates = {
        name: PoseEstimate(
            truth + (i + 1) * noise * torch.randn(count, 17, 3, generator=g),
            torch.rand(count, 17, generator=g) > 0.1,
        )
        for i, name in enumerate(("linear", "worst", "weight"))
    }
    return {
        "estimates": estimates,
        "truth": Truth(truth, torch.rand(count, 17, generator=g) > 0.1),
        "recording": recording,
    }


def predictions(tmp_path, values: dict, takes=TAKES):
    index = torch.arange(len(values["recording"]))
    writer = PredictionWriter(tmp_path / "rows", len(index), tuple(values["estimates"]), POSES)
    truth = values["truth"]
    sample = PoseSample(with_nan(truth), truth.valid, values["recording"], index)
    none = torch.zeros(len(index))
    writer.write(index, values["estimates"], sample, WeightSummary(none, none, none))
    tables = PoseTables.from_recordings([recording(name) for name in takes])
    writer.finish(tmp_path / "predictions.npz", tables, META)
    return open_predictions(tmp_path / "predictions.npz", POSES)


def relative(values: dict, name: str) -> np.ndarray:
    """Errors relative to the pelvis, NaN where they do not count: [N, 17]."""
    estimate = values["estimates"][name]
    counts = (estimate.estimated & values["truth"].valid).numpy()
    points, truth = estimate.points.double().numpy(), values["truth"].points.double().numpy()
    errors = np.linalg.norm(points - points[:, [PELVIS]] - truth + truth[:, [PELVIS]], axis=-1)
    return np.where(counts & counts[:, [PELVIS]], errors, np.nan)


def test_numbers_equal_numpy_on_the_same_arrays(tmp_path):
    values = content()
    metrics = evaluate_poses(predictions(tmp_path, values)).plain()
    recording = values["recording"].numpy()
    for name, numbers in metrics["selections"].items():
        errors = relative(values, name)
        assert numbers["mpjpe_relative"] == pytest.approx(np.nanmean(errors), rel=1e-6)
        assert numbers["mpjpe_6_joints"] == pytest.approx(
            np.nanmean(errors[:, SIX_JOINTS]), rel=1e-6
        )
        assert numbers["per_joint"]["left_wrist"] == pytest.approx(
            np.nanmean(errors[:, JOINTS.index("left_wrist")]), rel=1e-6
        )
        assert numbers["per_action"]["Greeting"] == pytest.approx(
            np.nanmean(errors[recording <= 1]), rel=1e-6
        )
        sound = errors[recording != 0]
        assert numbers["without_damaged"]["mpjpe_relative"] == pytest.approx(
            np.nanmean(sound), rel=1e-6
        )
        estimated, valid = values["estimates"][name].estimated, values["truth"].valid
        assert numbers["coverage"] == (estimated & valid).sum().item() / valid.sum().item()
        assert numbers["mpjpe_aligned"] < numbers["mpjpe_relative"]


def test_form_is_the_documented_one(tmp_path):
    metrics = evaluate_poses(predictions(tmp_path, content())).plain()
    assert list(metrics) == [
        "format_version",
        "data",
        "source",
        "split",
        "problem",
        "frames",
        "seed",
        "provenance",
        "selections",
    ]
    assert metrics["frames"] == 60
    assert metrics["seed"] == 7
    assert list(metrics["selections"]) == ["weight", "worst", "linear"]
    for numbers in metrics["selections"].values():
        assert list(numbers) == [
            *MEANS,
            "coverage",
            "per_joint",
            "per_action",
            "pose_prior",
            "without_damaged",
        ]
        assert list(numbers["without_damaged"]) == list(MEANS)
        assert list(numbers["pose_prior"]) == ["S11", "S9"]
        assert set(numbers["pose_prior"]["S9"]) == {
            "upper_arm",
            "lower_arm",
            "shoulder",
            "hip",
            "upper_leg",
            "lower_leg",
        }
    assert len(NAMES) == 16


def test_without_damaged_only_where_there_are_damaged_takes(tmp_path):
    metrics = evaluate_poses(predictions(tmp_path, content(takes=3), takes=TAKES[1:])).plain()
    assert all("without_damaged" not in numbers for numbers in metrics["selections"].values())


def test_chunks_do_not_matter(tmp_path, monkeypatch):
    opened = predictions(tmp_path, content())
    whole = evaluate_poses(opened).plain()
    monkeypatch.setattr("ghpt.models.pose.evaluation._CHUNK", 7)
    for name, numbers in evaluate_poses(opened).plain()["selections"].items():
        for mean in MEANS:
            assert numbers[mean] == pytest.approx(whole["selections"][name][mean], rel=1e-12)


def test_nothing_to_measure_is_null_and_never_nan(tmp_path):
    values = content()
    values["truth"] = replace(values["truth"], valid=torch.zeros(60, 17, dtype=torch.bool))
    metrics = evaluate_poses(predictions(tmp_path, values)).plain()
    write_json(tmp_path / "metrics.json", metrics)
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    weight = metrics["selections"]["weight"]
    assert all(weight[mean] is None for mean in (*MEANS, "coverage"))
    assert weight["pose_prior"]["S9"]["hip"] > 0  # the pose prior needs no truth


def test_leaving_hard_joints_out_shows_in_the_coverage(tmp_path):
    values = content()
    full = values["estimates"]["worst"]
    hard = torch.linalg.vector_norm(full.points - values["truth"].points, dim=-1) > 60
    values["estimates"]["weight"] = PoseEstimate(full.points, full.estimated & ~hard)
    selections = evaluate_poses(predictions(tmp_path, values)).plain()["selections"]
    assert selections["weight"]["mpjpe_absolute"] < selections["worst"]["mpjpe_absolute"]
    assert selections["weight"]["coverage"] < selections["worst"]["coverage"]
