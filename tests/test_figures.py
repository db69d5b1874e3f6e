import logging
import sys

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ghpt.geometry.cameras import Cameras
from ghpt.metrics.pose_prior import PARTS
from ghpt.models.aggregation import WeightSummary
from ghpt.models.pose.evaluation import evaluate_poses
from ghpt.models.pose.schema import POSES, PoseSample, PoseTables
from ghpt.models.predictions import PredictionWriter, open_predictions, with_nan
from ghpt.observations import PoseEstimate, Recording, Truth
from ghpt.report import figures
from ghpt.report.tables import pose_priors, title
from ghpt.report.tensorboard import SHOWN, write_events
from ghpt.skeleton import JOINT, JOINTS, PELVIS

STANDING = {
    "right_ankle": (-110, 0, 80),
    "right_knee": (-120, -60, 480),
    "right_hip": (-130, 0, 920),
    "left_hip": (130, 0, 920),
    "left_knee": (130, -180, 520),
    "left_ankle": (120, -40, 140),
    "pelvis": (0, 0, 920),
    "spine": (0, -20, 1150),
    "thorax": (0, -10, 1420),
    "head_top": (0, -20, 1690),
    "right_wrist": (-330, 150, 1000),
    "right_elbow": (-290, 0, 1150),
    "right_shoulder": (-170, 0, 1400),
    "left_shoulder": (170, 0, 1400),
    "left_elbow": (300, -50, 1180),
    "left_wrist": (280, -280, 1240),
    "nose": (0, -110, 1560),
}
PERSON = np.array([STANDING[joint] for joint in JOINTS], float)
"""Faces -y; z is up."""
META = {"data": "h36m", "source": "synthetic", "split": "test", "seed": 0, "provenance": {}}


def run(tmp_path, with_truth: bool = True):
    """Predictions of 40 frames, and their metrics."""
    cameras = Cameras(torch.zeros(2, 3, 3), torch.zeros(2, 3, 3), torch.zeros(2, 3))
    views, mask = np.zeros((0, 2, 17, 2), np.float32), np.zeros((0, 2, 17), bool)
    take = Recording(
        name="S9/Eating",
        subject="S9",
        action="Eating",
        rate_hz=50.0,
        camera_names=("a", "b"),
        cameras=cameras,
        key_points=views,
        confidence=views[..., 0],
        valid=mask,
        frame=np.zeros(0, np.int64),
    )
    g = torch.Generator().manual_seed(0)
    truth = torch.from_numpy(PERSON).float().expand(40, 17, 3) + torch.arange(40)[:, None, None]
    writer = PredictionWriter(tmp_path / "rows", 40, SHOWN, POSES)
    estimates = {
        name: PoseEstimate(
            truth + 20 * torch.randn(40, 17, 3, generator=g), torch.rand(40, 17, generator=g) > 0.02
        )
        for name in SHOWN
    }
    labels = Truth(truth, torch.full((40, 17), with_truth))
    weights = WeightSummary(*(torch.rand(40, generator=g) for _ in range(3)))
    rows = torch.arange(40)
    sample = PoseSample(with_nan(labels), labels.valid, 0 * rows, rows)
    writer.write(rows, estimates, sample, weights)
    writer.finish(tmp_path / "predictions.npz", PoseTables.from_recordings([take]), META)
    predictions = open_predictions(tmp_path / "predictions.npz", POSES)
    return predictions, evaluate_poses(predictions)


def test_view_shows_a_person_from_the_front_and_upright_in_any_world():
    turn = Rotation.from_euler("z", 77, degrees=True).as_matrix()
    y_down = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], float)
    images = []
    for world in (np.eye(3), turn, y_down, y_down @ turn):
        person = PERSON @ world.T
        up = figures.up_axis(person[None])
        np.testing.assert_allclose(up, world @ [0, 0, 1], atol=1e-12)
        view = figures._view(person, up)
        np.testing.assert_allclose(view @ view.T, np.eye(2), atol=1e-12)
        images.append((person - person[PELVIS]) @ view.T)
    for image in images:
        np.testing.assert_allclose(image, images[0], atol=1e-9)
    assert (
        images[0][JOINT["left_shoulder"], 0] > images[0][JOINT["right_shoulder"], 0]
    )  # facing the viewer
    assert images[0][JOINT["head_top"], 1] > 700


def test_skeletons_say_the_3d_error_and_draw_what_is_there():
    moved = PERSON.copy()
    moved[JOINT["nose"]] += [0, 170, 0]
    partial = np.full((17, 3), np.nan)
    partial[JOINT["left_knee"]] = PERSON[JOINT["left_knee"]]
    poses = {"weight": moved, "most": partial, "least": np.full((17, 3), np.nan)}
    figure = figures.skeletons(PERSON, poses, np.array([0.0, 0, 1]), "heading")
    assert [axes.get_title() for axes in figure.axes] == [
        "truth",
        "weight\n10.0 mm",
        "most\n0.0 mm",
        "least\nmissing",
    ]
    bones = [sum(len(c.get_segments()) for c in axes.collections) for axes in figure.axes]
    assert bones == [16, 32, 16, 16]
    assert {axes.get_xlim() for axes in figure.axes} == {figure.axes[0].get_xlim()}
    pixels = figures.image(figure)
    for colour in (figures.LEFT, figures.RIGHT, figures.TRUTH):
        rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
        assert (np.abs(pixels.astype(int) - rgb).max(-1) < 8).sum() > 50


def test_pose_prior_bars_show_each_value(tmp_path):
    _, measured = run(tmp_path)
    priors = pose_priors(measured, "S9")
    figure = figures.pose_prior_bars(priors, "S9", title(measured.run))
    (axes,) = figure.axes
    heights = [[bar.get_height() for bar in container] for container in axes.containers]
    names = [container.get_label() for container in axes.containers]
    assert names == ["weight", "most", "least", "random"]
    for name, bars in zip(names, heights, strict=True):
        assert bars == [priors[name][part] for part in PARTS]
    assert "synthetic" in axes.get_title()
    assert figures.image(figure).std() > 10


def test_pose_prior_bars_without_a_value_are_drawn():
    priors = {"weight": dict.fromkeys(PARTS)}
    assert figures.image(figures.pose_prior_bars(priors, "S9", "a run")).shape[2] == 3


def test_events_hold_the_numbers_of_metrics_json(tmp_path):
    predictions, measured = run(tmp_path)
    before = "matplotlib.pyplot" in sys.modules
    assert write_events(tmp_path / "events", predictions, measured) == 0
    assert ("matplotlib.pyplot" in sys.modules) == before
    events = EventAccumulator(str(tmp_path / "events"), size_guidance={"images": 0}).Reload()
    tags = events.Tags()
    (scalar,) = events.Scalars("test/weight")
    wanted = measured.selections["weight"].means.relative
    assert scalar.value == pytest.approx(wanted, rel=1e-6)
    assert all(tag.startswith("test/") for tag in tags["scalars"])
    assert tags["tensors"] == ["report/text_summary"]
    assert set(tags["images"]) == {"visual/skeletons", "visual/pose_prior_S9"}
    assert set(tags["histograms"]) == {f"weights/{x}" for x in ("entropy", "max", "effective")}
    assert any(tag.startswith("_hparams_") for tag in events.summary_metadata)


def test_data_without_truth_still_make_events(tmp_path):
    assert write_events(tmp_path / "events", *run(tmp_path, with_truth=False)) == 0


def test_failures_are_counted_said_once_and_stop_nothing(tmp_path, monkeypatch, caplog):
    predictions, measured = run(tmp_path)

    def broken(*_):
        raise OSError("no space left")

    monkeypatch.setattr("ghpt.report.tensorboard.skeletons", broken)
    monkeypatch.setattr("ghpt.report.tensorboard.pose_prior_bars", broken)
    with caplog.at_level(logging.WARNING, "ghpt"):
        assert write_events(tmp_path / "events", predictions, measured) == 2
    (record,) = caplog.records
    assert "no space left" in record.getMessage()
    events = EventAccumulator(str(tmp_path / "events")).Reload()
    assert "test/weight" in events.Tags()["scalars"]  # what comes after the failing parts is there
    (tmp_path / "file").write_text("")
    assert write_events(tmp_path / "file" / "events", predictions, measured) > 0
