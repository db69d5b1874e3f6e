import functools
import importlib.util
import sys
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from ghpt.data.synthetic import recordings
from ghpt.data.synthetic.detector import Detector
from ghpt.data.synthetic.recordings import HUMAN36M_SUBJECTS, synthetic_recordings
from ghpt.errors import GhptConfigError, GhptDataError
from ghpt.geometry.cameras import project
from ghpt.skeleton import BONES, JOINT

CONF = Path(__file__).parents[1] / "conf" / "detector"
DETECTOR = {
    name: Detector(**yaml.safe_load((CONF / f"{name}.yaml").read_text()))
    for name in ("human36m", "panoptic")
}


def drawn(data: str, split: str = "test", seed: int = 0, count: int = 1, cameras=None):
    detector = DETECTOR["human36m" if data == "h36m" else "panoptic"]
    return list(islice(synthetic_recordings(data, split, seed, detector, cameras), count))


first = functools.cache(drawn)
"""The same, drawn once for all tests."""


@pytest.fixture(scope="module")
def human36m():
    return first("h36m", count=3)


def test_recordings_are_complete(human36m):
    for recording in human36m:
        frames, views, joints = len(recording), 4, 17
        assert recording.key_points.shape == (frames, views, joints, 2)
        assert (
            recording.key_points.dtype
            == recording.confidence.dtype
            == recording.truth.dtype
            == np.float32
        )
        assert recording.valid.dtype == recording.truth_valid.dtype == bool
        assert np.isfinite(recording.key_points).all()
        assert recording.truth_valid.all()
        assert recording.valid.sum(axis=1).min() >= 0
        assert (recording.valid.sum(axis=1) >= 2).mean() > 0.97
        assert ((recording.confidence >= 0) & (recording.confidence <= 1)).all()
    assert [r.name for r in human36m] == ["S9/Directions-1", "S9/Directions-2", "S9/Discussion-1"]


def test_key_points_are_near_the_projected_truth(human36m):
    for recording in human36m + first("cmu3"):
        ideal, _ = project(recording.cameras, torch.from_numpy(recording.truth).double())
        error = np.linalg.norm(recording.key_points - ideal.numpy(), axis=-1)[recording.valid]
        assert 1.0 < np.median(error) < 12.0
        assert np.mean(error > 100) < 0.01


def test_a_subject_is_one_person_and_takes_differ(human36m):
    lengths = [
        np.stack(
            [np.linalg.norm(r.truth[:, a] - r.truth[:, b], axis=-1) for a, b in BONES[:6]]
        ).mean(axis=1)
        for r in human36m
    ]
    np.testing.assert_allclose(lengths[1], lengths[0], rtol=1e-5)
    assert np.abs(human36m[0].truth[:100] - human36m[1].truth[:100]).max() > 50
    other = first("h36m", "validation")[0]
    assert abs(np.linalg.norm(other.truth[0, 0] - other.truth[0, 1]) - lengths[0][0]) > 1.0


def test_splits_hold_their_subjects_and_all_actions(monkeypatch):
    assert HUMAN36M_SUBJECTS == {
        "train": ("S1", "S5", "S6", "S7"),
        "validation": ("S8",),
        "test": ("S9", "S11"),
    }
    short = dict.fromkeys(recordings.HUMAN36M_FRAMES, 16)
    monkeypatch.setattr(recordings, "HUMAN36M_FRAMES", short)
    names = [r.name for r in drawn("h36m", "validation", count=99)]
    assert len(names) == len(set(names)) == 30
    assert len({name.split("/")[1].split("-")[0] for name in names}) == 15


def test_the_same_seed_gives_the_same_recordings_in_any_order():
    again = drawn("h36m", count=2)[1]
    direct = first("h36m", count=2)[1]
    np.testing.assert_array_equal(again.key_points, direct.key_points)
    assert (first("h36m", seed=1)[0].truth != first("h36m")[0].truth).any()


def test_a_camera_sees_the_same_in_every_arrangement():
    cmu1, cmu3, alone = first("cmu1")[0], first("cmu3")[0], first("panoptic", cameras=(10, 5))[0]
    expected = cmu1.key_points[:, cmu1.camera_names.index("00_10")]
    for other in (cmu3, alone):
        np.testing.assert_array_equal(
            other.key_points[:, other.camera_names.index("00_10")], expected
        )
        np.testing.assert_array_equal(other.truth, cmu1.truth)


def test_panoptic_is_split_in_time(monkeypatch):
    monkeypatch.setattr(recordings, "PANOPTIC_FRAMES", 1000)
    parts = [drawn("cmu3", split)[0] for split in ("train", "validation", "test")]
    frames = np.concatenate([part.frame for part in parts])
    np.testing.assert_array_equal(frames, np.arange(len(frames)))
    assert [round(len(part) / len(frames), 2) for part in parts] == [0.6, 0.2, 0.2]
    for before, after in pairwise(parts):
        assert np.abs(after.truth[0] - before.truth[-1]).max() < 150


def test_people_stand_on_panoptics_floor_with_y_down():
    truth = first("cmu3")[0].truth
    assert np.median(truth[:, JOINT["nose"], 1]) < -1200
    assert -200 < np.median(truth[:, JOINT["left_ankle"], 1]) < 0


@pytest.mark.parametrize(
    ("data", "split", "cameras", "error", "word"),
    [
        ("cmu9", "test", None, GhptConfigError, "cmu9"),
        ("h36m", "dev", None, GhptConfigError, "dev"),
        ("panoptic", "test", (1, 99), GhptDataError, "camera 99"),
        ("panoptic", "test", (4,), GhptDataError, "two"),
    ],
)
def test_bad_choices_are_named_at_once(data, split, cameras, error, word):
    with pytest.raises(error, match=word):
        synthetic_recordings(data, split, 0, DETECTOR["panoptic"], cameras)


def test_the_learning_free_rows_of_the_paper_come_out():
    """The fit holds for the motion and the detector as they are now (scripts/fit_detector.py
    --check).
    """
    path = Path(__file__).parents[1] / "scripts" / "fit_detector.py"
    spec = importlib.util.spec_from_file_location("fit_detector", path)
    fit = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = fit
    spec.loader.exec_module(fit)
    drawn = fit.draws(DETECTOR["human36m"], "human36m", "test", 0)
    found = fit.table(DETECTOR["human36m"], "human36m", drawn, 0.02, 0)["h36m"]
    for row, target in fit.TARGETS["human36m"].items():
        assert found[row] == pytest.approx(target, rel=0.07), row
