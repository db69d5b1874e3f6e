"""test.py on the camera problem, from a checkpoint to the files that users read."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import toys
from composed import compose
from ghpt.commands.test import summary
from ghpt.errors import GhptConfigError
from ghpt.models.aggregation import AGGREGATIONS
from ghpt.models.predictions import open_predictions
from ghpt.models.relative_pose.schema import PAIRS
from toys import train

CONF = Path(__file__).resolve().parents[1] / "conf"
SMALL = [
    "model.hypotheses=6",
    "model.scorer.layers=[4]",
    "model.problem.frames=8",
    "model.problem.draws=2",
    "model.problem.points=20",
]
BASELINES = {"eight_point": {"_target_": "ghpt.models.relative_pose.baselines.EightPoint"}}


def model() -> dict[str, Any]:
    return compose("train", "model=camera", *SMALL)["model"]


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("trained")
    train(toys.TRAIN | {"model": model(), "trainer": toys.TRAINER | {"max_epochs": 1}}, folder)
    return folder / "last.ckpt"


def settings(checkpoint: Path, **changes: Any) -> dict[str, Any]:
    return (
        toys.TRAIN
        | {
            "ckpt": str(checkpoint),
            "camera_baselines": BASELINES,
            "baselines": {},
        }
        | changes
    )


def test_files_table_and_events(checkpoint, tmp_path, capsys):
    result = toys.run_test(settings(checkpoint), tmp_path)
    metrics = result.measured.plain()
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    assert (metrics["problem"], metrics["frames"], metrics["draws"]) == ("camera", 8, 2)
    assert list(metrics["selections"]) == [*AGGREGATIONS, "eight_point"]
    assert metrics["provenance"]["training"]["data"] == "toy"
    assert set(metrics["selections"]["weight"]["pairs"]) == {
        "1-2",
        "1-3",
        "1-4",
        "2-3",
        "2-4",
        "3-4",
    }
    shown = capsys.readouterr().out
    assert max(map(len, shown.splitlines())) <= 80
    assert "8-point" in shown
    assert "synthetic toy" in " ".join((tmp_path / "report.md").read_text().split())
    assert f"{metrics['selections']['weight']['E_3D']:.1f} mm" in summary(result)
    tags = EventAccumulator(str(tmp_path), size_guidance={"images": 0}).Reload().Tags()
    assert "visual/rig" in tags["images"]
    assert "test/weight" in tags["scalars"]
    assert not list(tmp_path.glob(".predictions*"))


def test_every_estimate_has_the_length_that_the_problem_s_scale_gives(checkpoint, tmp_path):
    toys.run_test(settings(checkpoint), tmp_path)
    opened = open_predictions(tmp_path / "predictions.npz", PAIRS)
    chunk = opened.read(0, len(opened))
    a, b = (opened.tables.cameras.centre[chunk.sample.rig, chunk.sample.pair[:, i]] for i in (0, 1))
    torch.testing.assert_close(chunk.sample.truth_t.norm(dim=-1), (a - b).norm(dim=-1))
    for name in ("most", "best", "eight_point"):
        estimate = chunk.estimates[name]
        assert estimate.estimated.all(), name
        torch.testing.assert_close(
            estimate.t.norm(dim=-1), (a - b).norm(dim=-1), rtol=1e-5, atol=0.01
        )


def test_another_number_of_frames_can_be_tested(checkpoint, tmp_path):
    result = toys.run_test(settings(checkpoint, frames=20, hypotheses=4), tmp_path)
    assert result.measured.run.frames == 20
    with pytest.raises(GhptConfigError, match="is 'many', not an integer"):
        toys.run_test(settings(checkpoint, frames="many"), tmp_path)


def test_the_same_bytes_twice(checkpoint, tmp_path):
    for name in ("a", "b"):
        toys.run_test(settings(checkpoint), tmp_path / name)
    one, two = (np.load(tmp_path / name / "predictions.npz") for name in ("a", "b"))
    assert one.files == two.files
    for member in one.files:
        np.testing.assert_array_equal(one[member], two[member])


def test_baselines_of_the_other_problem_are_not_built(checkpoint, tmp_path):
    other = {"linear": {"_target_": "no.such.Class"}}
    result = toys.run_test(settings(checkpoint, baselines=other), tmp_path)
    assert "linear" not in result.measured.selections
    with pytest.raises(GhptConfigError, match="camera_baselines: is 3, not a"):
        toys.run_test(settings(checkpoint, camera_baselines=3), tmp_path)
