"""What a problem gets that declares an estimate and nothing else: its file, metrics and report."""

from dataclasses import dataclass

import pytest
import torch

from ghpt.errors import GhptDataError
from ghpt.models.aggregation import WeightSummary
from ghpt.models.mean_error import mean_errors
from ghpt.models.pose.schema import POSES
from ghpt.models.predictions import PredictionWriter, TrueJoints, frame_schema, open_predictions
from ghpt.observations import Estimate, Truth
from ghpt.report.mean_error import REPORT
from ghpt.skeleton import PELVIS

FRAMES = 24
META = {"data": "h36m", "source": "synthetic", "split": "test", "seed": 0, "provenance": {}}


@dataclass(frozen=True)
class Point(Estimate):
    point: torch.Tensor
    estimated: torch.Tensor

    def valid(self):
        return self.estimated & self.point.isfinite().all(-1)


SCHEMA = frame_schema("point", Point, {"point": ("<f4", (3,)), "estimated": ("|b1", ())})


def distance(estimate, truth):
    compared = truth.valid[:, PELVIS] & estimate.estimated
    error = (estimate.point - truth.points[:, PELVIS]).norm(dim=-1)
    return torch.where(compared, error, 0.0), compared


def truth(valid: bool = True) -> Truth:
    points = torch.arange(FRAMES * 51.0).reshape(FRAMES, 17, 3)
    return Truth(points, torch.full((FRAMES, 17), valid))


def stored(folder, labels, processes=1):
    """Two estimators, 3 and 4 mm off, the second one in half of the frames and once not finite."""
    offset = torch.tensor([3.0, 0, 0])
    near = labels.points[:, PELVIS] + offset
    far = labels.points[:, PELVIS] + 4 / 3 * offset
    far[0] = torch.nan
    estimates = {
        "weight": Point(near, torch.ones(FRAMES, dtype=torch.bool)),
        "mine": Point(far, torch.arange(FRAMES) < FRAMES // 2),
    }
    sample = TrueJoints.from_truth(labels)
    none = torch.zeros(FRAMES)
    weights = WeightSummary(none, none, none)
    names = tuple(estimates)
    writers = [PredictionWriter(folder / "rows", FRAMES, names, SCHEMA) for _ in range(processes)]
    for part in torch.arange(FRAMES).split(5):
        for rank, writer in enumerate(writers):
            rows = part[rank::processes]
            parts = {name: estimate.rows(rows) for name, estimate in estimates.items()}
            writer.write(rows, parts, sample.rows(rows), weights.rows(rows))
    path = folder / "predictions.npz"
    writers[0].finish(path, SCHEMA.tables(), META)
    return open_predictions(path, SCHEMA)


def test_the_mean_error_is_over_the_frames_that_can_be_compared(tmp_path):
    metrics = mean_errors(stored(tmp_path, truth()), distance).plain()
    assert metrics["problem"] == "point"
    assert metrics["frames"] == FRAMES
    assert metrics["selections"]["weight"]["error"] == pytest.approx(3, rel=1e-6)
    assert metrics["selections"]["weight"]["coverage"] == 1
    assert metrics["selections"]["mine"]["error"] == pytest.approx(4, rel=1e-6)
    assert metrics["selections"]["mine"]["coverage"] == (FRAMES // 2 - 1) / FRAMES


def test_without_a_truth_there_is_no_error(tmp_path):
    metrics = mean_errors(stored(tmp_path, truth(valid=False)), distance).plain()
    assert metrics["selections"]["weight"] == {"error": None, "coverage": 0.0}


def test_several_processes_write_the_file_of_one(tmp_path):
    one = stored(tmp_path / "one", truth())
    three = stored(tmp_path / "three", truth(), processes=3)
    assert three.path.read_bytes() == one.path.read_bytes()


def test_the_report_has_a_row_for_each_estimator(tmp_path):
    predictions = stored(tmp_path, truth())
    measured = mean_errors(predictions, distance)
    assert REPORT.write_events(tmp_path / "events", predictions, measured) == 0
    for document in (REPORT.summary(measured), REPORT.document(measured)):
        (table,) = document.blocks
        assert [row[:2] for row in table.rows] == [("weight", "3.0"), ("mine", "4.0")]


def test_the_file_of_another_problem_is_refused(tmp_path):
    path = stored(tmp_path, truth()).path
    with pytest.raises(GhptDataError, match="'point', not 'pose'"):
        open_predictions(path, POSES)
