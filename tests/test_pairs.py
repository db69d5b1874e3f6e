"""Pairs of cameras as a data set: which frames, which pairs, which values."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import torch

from ghpt.data.datasets.pairs import Pairs, PairSettings
from ghpt.errors import GhptConfigError, GhptDataError
from ghpt.geometry.cameras import Cameras
from toys import recording

SETTINGS = PairSettings(frames=12, draws=3, points=50)


def recordings(views: int = 3) -> list:
    rng = np.random.default_rng(0)
    takes = [recording(f"S1/Walking-{i}", "S1", 20, views, 0.2, rng) for i in range(2)]
    other = recording("S2/Walking-1", "S2", 30, views, 0.2, rng)
    moved = Cameras(other.cameras.K, other.cameras.R, other.cameras.t + 1)
    return [*takes, replace(other, cameras=moved)]


def test_recordings_with_the_same_cameras_are_one_rig():
    pairs = Pairs(recordings(), SETTINGS, seed=0)
    assert [(rig.name, rig.recordings) for rig in pairs.rigs] == [("S1", (0, 1)), ("S2", (2,))]


def test_every_pair_of_every_draw_of_every_rig_and_those_of_a_draw_together():
    pairs = Pairs(recordings(), SETTINGS, seed=0)
    places = [pairs.locate(i) for i in range(len(pairs))]
    assert len(pairs) == 2 * 3 * 3
    assert places == [
        (draw // 3, draw, pair) for draw in range(6) for pair in combinations(range(3), 2)
    ]
    batch = pairs[range(len(pairs))].observations
    assert torch.equal(batch.draw, torch.arange(6).repeat_interleave(3))
    assert torch.equal(batch.key_points[0], batch.key_points[2])
    assert not torch.equal(batch.key_points[0], batch.key_points[3])


@pytest.mark.parametrize("samples", [None, 40])
def test_a_batch_holds_the_recordings_values_of_its_frames(samples):
    data = recordings()
    pairs = Pairs(data, SETTINGS, seed=5, samples=samples)
    for sample in (0, 7, len(pairs) - 1):
        rig, draw, pair = pairs.locate(sample)
        labelled = pairs[[sample]]
        batch = labelled.observations
        frames = pairs.locate_frames(rig, draw)
        assert sum(len(positions) for _, positions in frames) == 12
        assert all(len(set(positions)) == len(positions) for _, positions in frames)
        expected = np.concatenate([data[r].key_points[positions] for r, positions in frames])
        np.testing.assert_array_equal(batch.key_points[0].transpose(0, 1).numpy(), expected)
        valid = np.concatenate([data[r].valid[positions] for r, positions in frames])
        np.testing.assert_array_equal(
            batch.select_pair(batch.valid)[0].numpy(), valid[:, list(pair)].swapaxes(0, 1)
        )
        cameras = data[frames[0][0]].cameras.index(list(pair))
        assert torch.equal(labelled.truth.cameras.t[0], cameras.t)
        distance = torch.pdist(cameras.centre.double())
        torch.testing.assert_close(batch.baseline, distance)


def test_a_sample_does_not_depend_on_its_batch():
    pairs = Pairs(recordings(), SETTINGS, seed=0, samples=40)
    together, alone = pairs[[3, 17, 9]].observations, pairs[[17]].observations
    assert torch.equal(together.key_points[1], alone.key_points[0])
    assert torch.equal(together.pair[1], alone.pair[0])


def test_training_samples_take_all_rigs_and_pairs_and_their_own_frames():
    pairs = Pairs(recordings(), SETTINGS, seed=0, samples=200)
    places = [pairs.locate(i) for i in range(200)]
    assert {rig for rig, _, _ in places} == {0, 1}
    assert {pair for _, _, pair in places} == {(0, 1), (0, 2), (1, 2)}
    assert len({draw for _, draw, _ in places}) == 200
    assert len({tuple(pairs.locate_frames(0, draw)[0][1]) for draw in range(50)}) == 50


def test_frames_are_drawn_evenly():
    pairs = Pairs(recordings()[2:], PairSettings(10, 1, 5), seed=0, samples=3000)
    drawn = np.concatenate([pairs.locate_frames(0, draw)[0][1] for draw in range(3000)])
    count = np.bincount(drawn, minlength=30)
    assert count.sum() == 30_000
    assert (
        abs(count - 1000) < 5 * np.sqrt(1000 * 2 / 3)
    ).all()  # five deviations of a hypergeometric count


def test_a_rig_with_few_frames_fills_up_with_unseen_ones():
    batch = Pairs(recordings()[2:], PairSettings(40, 1, 5), seed=0)[[0]].observations
    assert batch.valid[0, :, :30].any(-1).all()
    assert not batch.valid[0, :, 30:].any()


def test_points_fill_the_box_of_the_true_joints():
    data = recordings()
    points = Pairs(data, PairSettings(5, 1, 5000), seed=0).rigs[1].points.numpy()
    truth = data[2].truth.reshape(-1, 3)
    low, high = truth.min(0), truth.max(0)
    assert (points >= low).all()
    assert (points <= high).all()
    np.testing.assert_allclose(points.mean(0), (low + high) / 2, atol=0.03 * (high - low).max())


def test_without_any_true_pose_there_is_a_named_error():
    blind = [replace(r, truth_valid=np.zeros_like(r.truth_valid)) for r in recordings()]
    with pytest.raises(GhptDataError, match=r"no true pose.*calibrate\.py"):
        Pairs(blind, SETTINGS, seed=0)


def test_an_empty_share_of_a_batch_has_the_right_shapes():
    batch = Pairs(recordings(), SETTINGS, seed=0)[[]].observations
    assert len(batch) == 0
    assert batch.key_points.shape == (0, 3, 12, 17, 2)
    assert batch.pair.shape == (0, 2)


@pytest.mark.parametrize("setting", ["frames", "draws", "points"])
def test_settings_that_cannot_work_are_named(setting):
    with pytest.raises(GhptConfigError, match=f"{setting}: is 0"):
        PairSettings(**{"frames": 1, "draws": 1, "points": 1, setting: 0})
