"""A trajectory while it is recorded: what it depends on, its states, and what it is worth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import ghpt
from ghpt.api import default_settings
from ghpt.commands.prediction.estimator import build_estimator
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.errors import GhptConfigError
from ghpt.geometry.state import State
from ghpt.models.estimators.trajectory.fixed_lag import Group, WindowTerms
from ghpt.skeleton import BONES, JOINT
from test_trajectory import CPU, Source, error, hide, walk

FRAMES = 70
LAG = 5  # frames of 0.1 s
RIG = human36m_rig("S8").cameras
PINHOLES = (RIG.K, RIG.R, RIG.t)


@pytest.fixture(scope="module")
def truth():
    return walk(FRAMES)[0]


@pytest.fixture(scope="module")
def batch():
    return walk(FRAMES)[1]


@pytest.fixture(scope="module")
def predictor():
    return build_estimator(default_settings(estimator="online")).predictor


@pytest.fixture(scope="module")
def result(predictor, batch):
    return predict(predictor, batch)


def predict(predictor, batch, rows=None):
    fitted = predictor.fit(Source(batch), 1)
    parts = [np.arange(len(batch))] if rows is None else rows
    found = [fitted.predict(Source(batch), part, 16, CPU, lambda frames: None) for part in parts]
    names = ("points", "state", "covariance")
    joined = {name: torch.cat([getattr(part, name) for part in found]) for name in names}
    return found[0] if rows is None else replace(found[0], **joined)


def test_a_walk_is_nearer_to_the_truth_than_its_frames_alone(result, batch, truth):
    frames = build_estimator(default_settings(estimator="frame")).predictor
    source = Source(batch)
    alone = frames.fit(source, 600).predict(source, np.arange(FRAMES), 64, CPU, lambda _: None)
    later = slice(20, None)  # once the bones are known
    assert (result.state == State.OBSERVED).all()
    assert error_of(result, truth, later) < 0.8 * error_of(alone, truth, later)


def error_of(part, truth, frames):
    return float((part.points - truth)[frames].norm(dim=-1).mean())


def test_what_comes_after_the_lag_changes_nothing(predictor, batch, result):
    first = 40
    moved = batch.key_points.clone()
    moved[first:] += 50 * torch.randn(moved[first:].shape)
    part = predict(predictor, replace(batch, key_points=moved))
    before = first - LAG
    for name in ("points", "state", "error", "covariance"):
        assert torch.equal(getattr(part, name)[:before], getattr(result, name)[:before])
    assert not torch.equal(part.points[before], result.points[before])


def test_any_shards_give_the_same_bytes(predictor, batch, result):
    rows = np.array_split(np.arange(FRAMES), 4)
    for order in (rows, [rows[0], rows[2]]):
        part = predict(predictor, batch, order)
        kept = np.concatenate(order)
        for name in ("points", "state", "covariance"):
            assert torch.equal(getattr(part, name), getattr(result, name)[kept])


def test_a_stream_in_any_chunks_gives_what_all_frames_at_once_give(batch, result):
    values = batch.key_points.double().numpy()
    predictor = ghpt.Predictor(estimator="online")
    points = []
    for frames in ([values[0], values[1:8], *values[8:]], [values]):
        poses = list(predictor.stream(frames, PINHOLES, rate_hz=50))
        assert [int(pose.frame[0]) for pose in poses] == list(range(FRAMES))
        points.append(np.concatenate([pose.points for pose in poses]))
    assert np.array_equal(points[0], points[1])
    assert np.allclose(points[0], result.points.numpy(), atol=0.01)  # of float32 pixels


def test_a_frame_is_given_when_its_lag_is_over(batch):
    taken = []

    def frames():
        for number, values in enumerate(batch.key_points[:12].double().numpy()):
            taken.append(number)
            yield values

    stream = ghpt.Predictor(estimator="online").stream(frames(), PINHOLES, rate_hz=50)
    next(stream)
    assert taken[-1] == LAG
    next(stream)
    assert taken[-1] == LAG + 1


def test_another_estimator_has_no_stream():
    with pytest.raises(GhptConfigError):
        next(ghpt.Predictor(estimator="linear").stream([], PINHOLES))


def test_what_no_view_sees_is_missing_and_found_again(predictor, batch, truth):
    wrist = JOINT["right_wrist"]
    knee = JOINT["left_knee"]
    damaged = hide(batch, range(25, 40), wrist, range(4))
    damaged = hide(damaged, range(20, 60), knee, (1, 2, 3))
    damaged.key_points[10, 2] = torch.nan
    part = predict(predictor, damaged)
    assert part.points.isfinite().all()
    assert (part.state[25:40, wrist] == State.FEW_VIEWS).all()
    assert (part.state[42:, wrist] == State.OBSERVED).all()
    assert (part.state[20:30, knee] == State.SUPPORTED).all()
    assert not part.has_position[47:58, knee].any()  # half a second after the last observation
    assert error(part, truth) < 40


def test_an_absent_person_and_a_cut_begin_anew(predictor, batch, truth):
    valid = batch.valid.clone()
    valid[:6] = False
    valid[12:40] = False
    index = batch.index + 1000 * (batch.index >= 55)
    part = predict(predictor, replace(batch, valid=valid, index=index))
    assert part.frame.tolist() == index.tolist()
    assert not part.has_position[:6].any()
    assert not part.has_position[12:40].any()
    assert part.has_position[40:].float().mean() > 0.99
    assert error(part, truth) < 40


def test_a_joint_that_has_been_lost_is_found_again(predictor, batch, truth):
    wrist = JOINT["left_wrist"]
    moved = batch.key_points.clone()
    moved[25:40, :3, wrist] += torch.tensor([200.0, 150.0])
    part = predict(predictor, replace(batch, key_points=moved))
    distance = (part.points - truth)[:, wrist].norm(dim=-1)
    assert float(distance[45:].max()) < 60


@pytest.mark.parametrize("count", [1, 2, 4])
def test_a_few_frames_without_a_lag_are_enough(batch, truth, count):
    predictor = build_estimator(default_settings(estimator="online", lag=0.0)).predictor
    part = predict(predictor, batch.rows(slice(0, count)))
    assert part.has_position.all()
    assert error(part, truth[:count]) < 40


def test_the_past_is_summed_up_exactly():
    """A prior for the frames that were left behind gives the solution of all frames."""
    generator = np.random.default_rng(0)
    frames = 8
    root = generator.normal(size=(frames, 17, 3, 3))
    whole = WindowTerms(
        blocks=root @ root.transpose(0, 1, 3, 2),
        right=generator.normal(size=(frames, 17, 3)),
        first=generator.random((frames - 1, 17)),
        second=generator.random((frames - 2, 17)),
        least=1e-3,
        directions=generator.normal(size=(frames, 16, 3)),
        pull=generator.normal(size=(frames, 16)),
    )

    def later(first):
        arrays = {name: getattr(whole, name) for name in WindowTerms.__annotations__}
        cut = {name: x[first:] for name, x in arrays.items() if isinstance(x, np.ndarray)}
        return replace(whole, **cut)

    group = Group(tuple(range(17)), BONES, tuple(range(16)))
    prior = None
    for first in range(4):
        prior = group.marginal(later(first), prior)
    expected = group.solve(whole, None)
    found = group.solve(later(4), prior)
    assert np.allclose(found.points, expected.points[4:])
    for frame in (0, 3):
        assert np.allclose(found.covariance(frame), expected.covariance(4 + frame))
