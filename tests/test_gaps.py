"""Filling and smoothing: only on request, only between what was observed, the same however it is
cut up.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.interpolate import PchipInterpolator
from scipy.signal import butter, sosfiltfilt

from ghpt.commands.prediction.gaps import (
    Gaps,
    apply_gaps,
    frame_step,
    gap_frames,
    unbroken_runs,
)
from ghpt.commands.prediction.shards import Shards
from ghpt.errors import GhptConfigError
from ghpt.export.stream import part
from ghpt.reconstruction import State
from predicting import sequence_of
from reconstructions import random_reconstruction

S, F, M = int(State.OBSERVED), int(State.FILLED), int(State.FEW_VIEWS)


def path(*states: int, frame=None, seed=0):
    state = np.array(states, np.int8)
    points = np.random.default_rng(seed).normal(0, 500, (len(state), 3)).astype(np.float32)
    return np.arange(len(state)) if frame is None else np.array(frame), points, state


def filling(longest, kind="linear"):
    return Gaps(longest, kind, None, None)


def smoothing(hertz, rate=100.0):
    return Gaps(None, "pchip", hertz, rate)


def test_gaps_up_to_the_longest_are_filled_and_no_other():
    found = filling(2)(*path(S, M, S, M, M, S, M, M, M, S))[1]
    assert found.tolist() == [S, F, S, F, F, S, M, M, M, S]


@pytest.mark.parametrize("kind", ["linear", "pchip"])
def test_nothing_is_invented_before_the_first_or_after_the_last(kind):
    frame, points, state = path(M, M, S, M, S, M)
    found, states = filling(100, kind)(frame, points, state)
    assert states.tolist() == [M, M, S, F, S, M]
    kept = states != F
    assert np.array_equal(found[kept], points[kept])


def test_linear_is_the_line_between_the_neighbours():
    frame, points, state = path(S, M, M, S)
    found, _ = filling(2)(frame, points, state)
    expected = [points[0] + (points[3] - points[0]) * t for t in (1 / 3, 2 / 3)]
    np.testing.assert_allclose(found[1:3], expected, rtol=1e-5)


def test_pchip_stays_between_its_neighbours_and_is_scipys():
    frame, points, state = path(*[S, S, M, M, S, S, M, S])
    found, _ = filling(2, "pchip")(frame, points, state)
    known = state == S
    expected = PchipInterpolator(frame[known], points[known].astype(float), axis=0)(frame)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-3)
    low, high = np.minimum(points[1], points[4]), np.maximum(points[1], points[4])
    assert ((found[2:4] >= low - 1e-3) & (found[2:4] <= high + 1e-3)).all()


def test_a_frame_that_is_left_out_counts_as_a_part_of_the_gap():
    numbers = [0, 1, 3, 4]  # 2 is in no file
    assert filling(1)(*path(S, M, S, S, frame=numbers))[1].tolist() == [S, M, S, S]
    assert filling(2)(*path(S, M, S, S, frame=numbers))[1].tolist() == [S, F, S, S]


def test_every_tenth_frame_is_a_step_of_one():
    frame = np.arange(0, 60, 10)
    assert frame_step(frame) == 10
    assert filling(1)(*path(S, M, S, M, M, S, frame=frame))[1].tolist() == [S, F, S, M, M, S]


@pytest.mark.parametrize("states", [(M, M, M), (S,), (M,), (), (S, M, M), (M, M, S)])
def test_too_little_to_fill_or_smooth_is_left_alone(states):
    frame, points, state = path(*states)
    for gaps in (filling(9), filling(9, "pchip"), smoothing(5.0)):
        found, after_states = gaps(frame, points, state)
        np.testing.assert_array_equal(found, points)
        assert after_states.tolist() == list(states)


def test_slow_motion_passes_and_fast_jitter_does_not():
    t = np.arange(400) / 100
    slow, fast = np.sin(2 * np.pi * 1.0 * t), 0.5 * np.sin(2 * np.pi * 30 * t)
    points = np.stack([slow + fast, slow, fast], axis=-1).astype(np.float32)
    found, _ = smoothing(8.0)(np.arange(400), points, np.zeros(400, np.int8))
    middle = slice(50, 350)
    assert np.abs(found[middle, 0] - slow[middle]).max() < 0.01  # in phase, and of its size
    assert np.abs(found[middle, 2]).max() < 0.01


def test_runs_do_not_touch_each_other():
    frame, points, state = path(*[S] * 30, M, *[S] * 30)
    other = points.copy()
    other[31:] += 1000
    one, two = (smoothing(5.0)(frame, p, state)[0] for p in (points, other))
    np.testing.assert_array_equal(one[:30], two[:30])
    np.testing.assert_array_equal(one[30], points[30])
    assert np.abs(one[:30] - points[:30]).max() > 1


def test_runs_end_where_a_number_is_left_out():
    placed = np.array([1, 1, 0, 1, 1, 1], bool)
    found = unbroken_runs(np.array([0, 1, 2, 3, 5, 6]), placed, 1)
    assert [run.tolist() for run in found] == [[0, 1], [3], [4, 5]]
    assert unbroken_runs(np.arange(3), np.zeros(3, bool), 1) == []


@pytest.mark.parametrize(
    "gaps", [filling(3, "pchip"), smoothing(5.0), Gaps(3, "linear", 5.0, 100.0)]
)
@pytest.mark.parametrize("size", [7, 40, 1000])
def test_the_borders_between_shards_do_not_show(tmp_path, gaps, size):
    whole = random_reconstruction(90)
    shards = Shards(tmp_path, "key", 90, size)
    for shard in shards.missing():
        shards.write(shard, part(whole, shards.rows(shard).start, shards.rows(shard).stop))
    with apply_gaps(gaps, shards, 17, tmp_path) as chunks:
        found = [list(chunks()), list(chunks())]
    shards.close()
    points = torch.cat([chunk.points for chunk in found[0]])
    state = torch.cat([chunk.state for chunk in found[0]])
    assert torch.equal(
        points, torch.cat([chunk.points for chunk in found[1]])
    )  # called more than once
    for joint in range(17):
        expected = gaps(
            whole.frame.numpy(), whole.points[:, joint].numpy(), whole.state[:, joint].numpy()
        )
        np.testing.assert_array_equal(points[:, joint], expected[0])
        np.testing.assert_array_equal(state[:, joint], expected[1])
    filled = (state == State.FILLED) & (whole.state != State.FILLED)
    assert bool(filled.any()) == (gaps.longest is not None)
    assert not torch.cat([chunk.error for chunk in found[0]])[filled].any()
    assert not [
        p
        for p in tmp_path.iterdir()
        if p.suffix != ".npz" and p.name not in ("manifest.jsonl", "lock")
    ]


def test_without_a_request_nothing_is_done(tmp_path):
    assert Gaps(None, "pchip", None, None).changes_nothing
    assert gap_frames(None, 50.0) is None
    assert len(sequence_of(3)) == 3


@pytest.mark.parametrize(
    ("fill", "rate", "frames"),
    [(6, None, 6), ("0.1s", 60.0, 6), ("0.1 s", 60.0, 6), (".5s", 10.0, 5), ("1s", 29.97, 29)],
)
def test_gaps_are_given_in_frames_or_seconds(fill, rate, frames):
    assert gap_frames(fill, rate) == frames


@pytest.mark.parametrize(
    ("fill", "rate", "said"),
    [
        (0, 60.0, "is 0"),
        (-1, 60.0, "is -1"),
        ("6", 60.0, "'6'"),
        ("long", 60.0, "'long'"),
        ("0.1s", None, "frame rate"),
        ("0.001s", 60.0, "less than a frame"),
    ],
)
def test_other_gaps_are_named_errors(fill, rate, said):
    with pytest.raises(GhptConfigError, match=f"fill: .*{said}"):
        gap_frames(fill, rate)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((1, "cubic", None, None), "interpolation: is 'cubic'"),
        ((None, "pchip", 6.0, None), "smooth: needs the frame"),
        ((None, "pchip", 6.0, 12.0), "smooth: is 6 Hz"),
        ((None, "pchip", 0.0, 12.0), "smooth: is 0 Hz"),
        ((None, "pchip", -1.0, 12.0), "smooth: is -1 Hz"),
    ],
)
def test_a_filter_that_cannot_be_is_a_named_error(arguments, said):
    with pytest.raises(GhptConfigError, match=said):
        Gaps(*arguments)


def test_filled_is_the_gap_alone():
    frame, points, state = path(S, M, M, S, M, M, M, S)
    found, states = filling(2)(frame, points, state)
    changed = (found != points).any(-1)
    assert np.flatnonzero(changed).tolist() == [1, 2]
    assert np.flatnonzero(states == F).tolist() == [1, 2]


@pytest.mark.parametrize("count", [2, 5, 9, 10, 11, 40])
def test_smoothing_is_a_butterworth_filter_of_second_order_in_both_directions(count):
    frame, points, state = path(*[S] * count)
    padding = min(9, count - 1)  # three times the filter's three coefficients
    low_pass = butter(2, 5.0, fs=100.0, output="sos")
    expected = sosfiltfilt(low_pass, points.astype(float), axis=0, padlen=padding)
    found, _ = smoothing(5.0)(frame, points.astype(float), state)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_a_frame_alone_is_not_smoothed():
    frame, points, state = path(*[S, M] * 50, seed=3)
    found, _ = smoothing(5.0)(frame, points.astype(float), state)
    assert np.array_equal(found, points)


def test_smoothing_goes_through_what_was_filled():
    frame, points, state = path(*[S] * 20, M, M, *[S] * 20)
    filled, _ = filling(2)(frame, points.astype(float), state)
    expected, _ = smoothing(5.0)(frame, filled, np.zeros_like(state))
    found, states = Gaps(2, "linear", 5.0, 100.0)(frame, points.astype(float), state)
    np.testing.assert_array_equal(found, expected)
    assert states[20:22].tolist() == [F, F]


def test_what_is_missing_keeps_its_reason_and_place():
    frame, points, state = path(S, M, M, M, S, int(State.PARALLEL), S)
    found, states = Gaps(1, "linear", 5.0, 100.0)(frame, points, state)
    assert states.tolist() == [S, M, M, M, S, F, S]
    assert np.array_equal(found[1:4], points[1:4])


@pytest.mark.parametrize(
    ("frame", "step"), [([], 1), ([7], 1), ([0, 10], 10), ([0, 1, 2, 9], 1), ([0, 2, 4, 5], 2)]
)
def test_the_step_is_the_usual_distance(frame, step):
    assert frame_step(np.array(frame, np.int64)) == step


def test_runs_of_every_tenth_frame_end_where_one_is_left_out():
    frame = np.array([0, 10, 20, 40, 50])
    found = unbroken_runs(frame, np.ones(5, bool), 10)
    assert [run.tolist() for run in found] == [[0, 1, 2], [3, 4]]


@pytest.mark.parametrize(
    ("fill", "rate", "frames"), [(1, None, 1), ("0.1s", 10.0, 1), ("4s", 0.5, 2), ("2s", 0.75, 1)]
)
def test_a_gap_of_one_frame_and_a_slow_rate_are_some(fill, rate, frames):
    assert gap_frames(fill, rate) == frames


@pytest.mark.parametrize(
    ("fill", "rate", "said"),
    [
        (True, 60.0, "is True"),
        ("1s", 0.0, "needs the frame rate"),
        ("1s", -0.5, "needs the frame rate"),
        ("1s", np.nan, "needs the frame rate"),
        ("1s", np.inf, "needs the frame rate"),
    ],
)
def test_what_is_no_gap_or_no_rate_is_named(fill, rate, said):
    with pytest.raises(GhptConfigError, match=f"fill: {said}"):
        gap_frames(fill, rate)


@pytest.mark.parametrize(("cut_off", "rate"), [(0.1, 0.5), (0.5, 10.0), (5.9, 12.0)])
def test_a_filter_below_half_the_rate_can_be(cut_off, rate):
    assert not Gaps(None, "pchip", cut_off, rate).changes_nothing


@pytest.mark.parametrize(
    ("cut_off", "rate", "said"),
    [
        (0.1, -0.5, "needs the frame rate"),
        (0.1, 0.0, "needs the frame rate"),
        (0.1, np.inf, "needs the frame rate"),
        (-0.5, 12.0, "is -0.5 Hz"),
        (0.0, 12.0, "is 0 Hz"),
    ],
)
def test_a_rate_or_a_cut_off_that_is_not_positive_is_named(cut_off, rate, said):
    with pytest.raises(GhptConfigError, match=f"smooth: {said}"):
        Gaps(None, "pchip", cut_off, rate)


def test_either_request_is_something_and_none_takes_no_file(tmp_path, monkeypatch):
    assert not filling(3).changes_nothing
    assert not smoothing(5.0).changes_nothing
    shards = Shards(tmp_path, "key", 90, 40)
    monkeypatch.setattr("ghpt.commands.prediction.gaps.allocate", None)
    with apply_gaps(Gaps(None, "linear", None, None), shards, 17, tmp_path) as chunks:
        assert chunks == shards.chunks
    shards.close()


@pytest.mark.parametrize("gaps", [filling(3), smoothing(5.0)])
def test_far_from_the_zero_paths_keep_their_digits(tmp_path, gaps):
    whole = random_reconstruction(30)
    far = replace(whole, points=whole.points + 1e10)
    shards = Shards(tmp_path, "key", 30, 12)
    for shard in shards.missing():
        shards.write(shard, part(far, shards.rows(shard).start, shards.rows(shard).stop))
    with apply_gaps(gaps, shards, 17, tmp_path) as chunks:
        found = torch.cat([chunk.points for chunk in chunks()])
    shards.close()
    for joint in range(17):
        points, state = whole.points[:, joint].numpy(), whole.state[:, joint].numpy()
        expected, _ = gaps(whole.frame.numpy(), points, state)
        np.testing.assert_allclose(found[:, joint].numpy() - 1e10, expected, atol=1e-3)
