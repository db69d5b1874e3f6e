import logging
import sys

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ghpt.models.relative_pose.evaluation import evaluate_pairs
from ghpt.observations import RelativePoseEstimate
from ghpt.report import pair_figures
from ghpt.report.figures import image
from ghpt.report.pair_figures import rig_figure
from ghpt.report.pair_tensorboard import _typical_draw, write_pair_events
from pair_report import content, moved, rig, true_poses, written

RIGS = [rig(9), rig(11)]
ALL = torch.tensor([(a, b) for a in range(4) for b in range(a + 1, 4)])


def run(tmp_path, views: int = 4, draws: int = 3):
    rigs = [rig(9, views), rig(11, views)]
    predictions = written(tmp_path, rigs, content(rigs, draws))
    return predictions, evaluate_pairs(predictions)


def test_up_is_up_and_right_is_the_first_cameras():
    right, forward, up = pair_figures._axes_of(RIGS[0].cameras)
    np.testing.assert_allclose(
        np.stack((right, forward, up)) @ np.stack((right, forward, up)).T, np.eye(3), atol=1e-12
    )
    assert up[2] > 0.98  # the rig's z is up
    towards = RIGS[0].cameras.R[0, 2].numpy()
    assert forward @ towards > 0.95  # the first camera looks up the page
    assert np.linalg.det(np.stack((right, forward, up))) == pytest.approx(
        1
    )  # seen from above, not mirrored


def test_rig_figure_draws_each_target_where_the_estimate_has_it():
    own = RIGS[0]
    truth = true_poses([own], torch.zeros(6, dtype=torch.int64), ALL)
    exact = pair_figures._targets(own.cameras, ALL, moved(truth, 0.0, 0.0, seed=0))
    torch.testing.assert_close(exact.centre, own.cameras.centre[ALL[:, 1]])
    estimate = moved(truth, 0.2, 0.0, seed=0)
    figure = rig_figure(own.cameras, own.names, own.points, ALL, {"weight": estimate}, "heading")
    above, side = figure.axes
    lines = [len(c.get_segments()) for c in above.collections]
    assert lines == [4 * 8, 6 * 8, 6]  # true pyramids, estimated pyramids, stalks
    assert [text.get_text() for text in above.texts] == ["1: c0", "2: c1", "3: c2", "4: c3"]
    distance = (
        pair_figures._targets(own.cameras, ALL, estimate).centre - own.cameras.centre[ALL[:, 1]]
    ).norm(dim=-1)
    (legend,) = figure.legends
    said = [text.get_text() for text in legend.get_texts()]
    assert said[1].startswith(
        f"weight: targets' centres {distance.min():.0f} to {distance.max():.0f} mm off"
    )
    assert above.get_aspect() == side.get_aspect() == 1
    assert image(figure).std() > 10


def test_rig_figure_without_estimates_or_with_wild_ones_is_drawn():
    own = RIGS[0]
    truth = true_poses([own], torch.zeros(6, dtype=torch.int64), ALL)
    none = RelativePoseEstimate(
        torch.eye(3).double().expand(6, 3, 3), torch.zeros(6, 3).double(), torch.zeros(6) > 0
    )
    wild = RelativePoseEstimate(truth[0], truth[1] * 1e6, torch.arange(6) > 0)
    figure = rig_figure(
        own.cameras, own.names, own.points, ALL, {"weight": none, "rig": wild}, "heading"
    )
    said = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "no pair was estimated" in said[1]
    assert "1 of 6 pairs have none" in said[2]
    assert np.ptp(figure.axes[0].get_xlim()) < 20  # metres: the true rig, not the wild camera
    assert image(figure).std() > 10


def test_the_figure_is_of_a_draw_that_is_median(tmp_path):
    values = content(RIGS, draws=3)
    truth = values["truth"]
    factor = 1 + 0.01 * (
        values["draw"].double()[:, None] * 7 % 6
    )  # draws 0 to 5: 0 1 2 3 4 5 in another order
    values["estimates"]["weight"] = RelativePoseEstimate(
        truth[0], truth[1] * factor, torch.ones(36) > 0
    )
    rows = _typical_draw(written(tmp_path, RIGS, values))
    assert len(rows) == 6
    assert factor[rows].unique().item() == pytest.approx(1.02)


def test_events_hold_the_numbers_of_metrics_json(tmp_path):
    predictions, measured = run(tmp_path)
    before = "matplotlib.pyplot" in sys.modules
    assert write_pair_events(tmp_path / "events", predictions, measured) == 0
    assert ("matplotlib.pyplot" in sys.modules) == before
    events = EventAccumulator(str(tmp_path / "events"), size_guidance={"images": 0}).Reload()
    tags = events.Tags()
    (scalar,) = events.Scalars("test/weight")
    assert scalar.value == pytest.approx(measured.selections["weight"].headline, rel=1e-6)
    assert all(tag.startswith("test/") for tag in tags["scalars"])
    assert tags["tensors"] == ["report/text_summary"]
    assert set(tags["images"]) == {"visual/rig"}
    assert set(tags["histograms"]) == {f"weights/{x}" for x in ("entropy", "max", "effective")}
    assert any(tag.startswith("_hparams_") for tag in events.summary_metadata)


def test_failures_are_counted_said_once_and_stop_nothing(tmp_path, monkeypatch, caplog):
    predictions, measured = run(tmp_path)

    def broken(*_):
        raise OSError("no space left")

    monkeypatch.setattr("ghpt.report.pair_tensorboard.rig_figure", broken)
    with caplog.at_level(logging.WARNING, "ghpt"):
        assert write_pair_events(tmp_path / "events", predictions, measured) == 1
    (record,) = caplog.records
    assert "no space left" in record.getMessage()
    events = EventAccumulator(str(tmp_path / "events")).Reload()
    assert "test/weight" in events.Tags()["scalars"]  # what comes after the failing part is there
    (tmp_path / "file").write_text("")
    assert write_pair_events(tmp_path / "file" / "events", predictions, measured) > 0
