"""The trajectory of a person: its linear algebra, windows, states and what it is worth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import sizes
from ghpt.api import default_settings
from ghpt.commands.prediction.estimator import build_estimator
from ghpt.data.synthetic.recordings import draw_motion
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.geometry.cameras import Cameras, project
from ghpt.geometry.state import State
from ghpt.models.estimators.trajectory.disjoint import DisjointTest, square_distances
from ghpt.models.estimators.trajectory.groups import body_groups, spanning_bones
from ghpt.models.estimators.trajectory.inverse import tridiagonal_inverse
from ghpt.models.estimators.trajectory.normal_matrix import (
    UPPER,
    ConjugateGradients,
    NormalEquations,
    TimeCoupling,
    solve,
)
from ghpt.models.estimators.trajectory.sides import sided_limbs
from ghpt.models.estimators.trajectory.windows import Clock, Windows, spread_runs
from ghpt.observations import Observations
from ghpt.skeleton import BONES, HUMAN36M, JOINT, MIRROR

FRAMES = 130
CPU = torch.device("cpu")
NOISE = 4.0
"""Pixels."""


@pytest.fixture(scope="module")
def truth():
    return walk(FRAMES)[0]


@pytest.fixture(scope="module")
def batch():
    return walk(FRAMES)[1]


def walk(frames):
    """Return a person who walks before Human3.6M's four cameras, and what they see with noise."""
    motion = draw_motion(0, "S8", "S8/Walking-1", "Walking", FRAMES, 50.0)
    truth = torch.from_numpy(motion)[:frames]
    rig = human36m_rig("S8").cameras.to(torch.float64)
    pixels, _ = project(rig.expand(FRAMES), torch.from_numpy(motion))
    noise = torch.randn(pixels.shape, generator=torch.Generator().manual_seed(0))
    valid = torch.ones(pixels.shape[:-1], dtype=torch.bool)
    batch = Observations(
        index=torch.arange(FRAMES),
        recording=torch.zeros(FRAMES, dtype=torch.int64),
        cameras=rig.expand(FRAMES),
        key_points=(pixels + NOISE * noise).float(),
        confidence=torch.ones(valid.shape),
        valid=valid,
    )
    return truth, batch.rows(slice(0, frames))


@pytest.fixture(scope="module")
def predictor():
    return build_estimator(default_settings()).predictor


@pytest.fixture(scope="module")
def fitted(predictor, batch):
    """Return the predictor that has learned what the whole recording says."""
    return predictor.fit(Source(batch), 600)


@pytest.fixture(scope="module")
def result(fitted, batch):
    return predict_rows(fitted, Source(batch))


class Source:
    """Observations as a recording that is read row by row."""

    def __init__(self, batch: Observations, rate_hz: float | None = 50.0) -> None:
        self.batch = batch
        self.frame = batch.index.numpy()
        self.rate_hz = rate_hz

    def read(self, rows) -> Observations:
        return self.batch.rows(torch.from_numpy(np.asarray(rows)))


def predict(predictor, source):
    return predict_rows(predictor.fit(source, 600), source)


def predict_rows(fitted, source, rows=None):
    rows = np.arange(len(source.frame)) if rows is None else rows
    return fitted.predict(source, rows, 64, CPU, lambda frames: None)


def error(part, truth, joints=slice(None)):
    """Return the mean distance from the truth of the joints with a position, mm."""
    distance = (part.points - truth).norm(dim=-1)[:, joints]
    return float(distance[part.has_position[:, joints]].mean())


def hide(batch, frames, joints, views):
    """Return the batch without some key points."""
    valid = batch.valid.clone()
    for frame in frames:
        for view in views:
            valid[frame, view, joints] = False
    return replace(batch, valid=valid)


def test_a_walk_is_nearer_to_the_truth_than_its_frames_alone(predictor, batch, result, truth):
    frames = build_estimator(default_settings(estimator="frame")).predictor
    alone = predict(frames, Source(batch))
    assert error(result, truth) < 0.8 * error(alone, truth)
    assert (result.state == State.OBSERVED).float().mean() > 0.99


def test_true_positions_are_within_the_ellipsoids(result, truth):
    """White noise is no worse than said: the covariances are of errors that last."""
    offset = (result.points - truth)[result.is_measured]
    square = square_distances(offset, result.covariance[result.is_measured].double())
    shares = DisjointTest(square).coverage()
    assert shares[0] > 0.45
    assert shares[1] > 0.75


@pytest.mark.parametrize("shards", sizes.representatives([3], [11]))
def test_any_shards_give_the_same_bytes(fitted, batch, shards):
    source = Source(batch)
    windowed = replace(fitted, windows=Windows(length=50, overlap=25))
    whole = predict_rows(windowed, source)
    rows = np.array_split(np.arange(FRAMES), shards)
    parts = [predict_rows(windowed, source, some) for some in rows]
    points = torch.cat([part.points for part in parts])
    assert torch.equal(points, whole.points)
    assert torch.equal(torch.cat([part.state for part in parts]), whole.state)


def test_the_border_of_a_window_does_not_show(fitted, batch, result):
    narrow = replace(fitted, windows=Windows(length=40, overlap=50))
    windowed = predict_rows(narrow, Source(batch))
    assert float((windowed.points - result.points).norm(dim=-1).max()) < 0.05


def test_one_view_supports_a_joint_that_is_observed_near_by(fitted, batch, truth):
    wrist = JOINT["right_wrist"]
    gap = range(60, 72)
    part = predict_rows(fitted, Source(hide(batch, gap, wrist, (1, 2, 3))))
    states = part.state[list(gap), wrist]
    assert (states == State.SUPPORTED).all()
    assert part.views[list(gap), :, wrist].sum(-1).tolist() == [1] * len(gap)
    assert error(part, truth, [wrist]) < 40
    before = part.covariance[40:55, wrist, [0, 3, 5]].sum(-1).mean()
    within = part.covariance[list(gap), wrist][:, [0, 3, 5]].sum(-1).mean()
    assert within > 1.5 * before


def test_what_one_view_sees_for_long_is_as_uncertain_as_it_is_wrong(fitted, batch, truth):
    """A bone fits at two depths along a ray, and an estimate that nothing contradicts is smooth."""
    gap = slice(30, 78)
    hidden = hide(batch, range(30, 78), slice(None), (1, 2, 3))
    part = predict_rows(fitted, Source(hidden))
    carried = part.state[gap] == State.SUPPORTED
    assert carried.float().mean() > 0.95
    variance = part.covariance[gap][carried][:, [0, 3, 5]].double()
    assert variance.min() > 0
    offset = (part.points - truth)[gap][carried]
    assert (offset.norm(dim=-1) / variance.sum(-1).sqrt()).max() < 7


def test_what_a_detector_guesses_with_little_confidence_spoils_nothing(fitted, batch, truth):
    """Half of the views take an arm for another, at first these, then those."""
    arm = [JOINT["left_elbow"], JOINT["left_wrist"]]
    key_points = batch.key_points.clone()
    confidence = torch.full_like(batch.confidence, 0.9)
    half = slice(None, FRAMES // 2), slice(FRAMES // 2, None)
    for frames, views in zip(half, ((0, 1), (2, 3)), strict=True):
        for view in views:
            key_points[frames, view, arm] += torch.tensor([120.0, 40.0])
            confidence[frames, view, arm] = 0.1
    guessed = replace(batch, key_points=key_points, confidence=confidence)
    found = predict_rows(fitted, Source(guessed))
    seen = batch.valid & (confidence > 0.5)
    assert error(found, truth, arm) < 2 * error(
        predict_rows(fitted, Source(replace(batch, valid=seen))), truth, arm
    )


def test_what_no_view_sees_is_missing(fitted, batch):
    wrist = JOINT["right_wrist"]
    gap = list(range(60, 72))
    part = predict_rows(fitted, Source(hide(batch, gap, wrist, range(4))))
    assert (part.state[gap, wrist] == State.FEW_VIEWS).all()
    assert (part.state[:, JOINT["left_wrist"]] == State.OBSERVED).all()


def test_one_view_far_from_an_observation_supports_nothing(fitted, batch):
    ankle = JOINT["left_ankle"]
    part = predict_rows(fitted, Source(hide(batch, range(40, 130), ankle, (0, 1, 2))))
    reach = 25  # half a second
    supported = part.state[:, ankle] == State.SUPPORTED
    assert not supported[40 + reach :].any()
    assert supported[40 : 40 + reach - 2].all()


def test_sides_that_a_view_exchanges_for_a_while_are_put_right(fitted, batch, result):
    flipped = batch.key_points.clone()
    flipped[50:70, 2] = flipped[50:70, 2][:, list(MIRROR)]
    part = predict_rows(fitted, Source(replace(batch, key_points=flipped)))
    found = part.flipped[:, 2]
    assert found[52:68].all()
    assert not found[:48].any()
    assert float((part.points - result.points).norm(dim=-1)[52:68].mean()) < 10


def test_a_cut_parts_the_recording(predictor, batch):
    jump = 10_000
    index = batch.index + jump * (batch.index >= 65)
    moved = replace(batch, index=index)
    part = predict(predictor, Source(moved))
    first = predict(predictor, Source(moved.rows(slice(0, 65))))
    assert part.frame.tolist() == index.tolist()
    assert float((part.points[:65] - first.points).norm(dim=-1).mean()) < 3


def test_a_person_who_is_suddenly_elsewhere_is_followed(fitted, batch, truth):
    """The rig moves instead: a cut that frame numbers do not show."""
    offset = torch.zeros(FRAMES, 3, dtype=torch.float64)
    offset[65:, 0] = 700.0
    cameras = batch.cameras
    moved = Cameras(
        cameras.K, cameras.R, cameras.t - torch.einsum("tvij,tj->tvi", cameras.R, offset)
    )
    part = predict_rows(fitted, Source(replace(batch, cameras=moved)))
    near = slice(60, 70)
    distance = (part.points - truth - offset[:, None])[near].norm(dim=-1)
    assert (part.state[near] == State.OBSERVED).all()
    assert float(distance.mean()) < 30


@pytest.mark.parametrize("count", sizes.representatives([1, 3], [2]))
def test_a_few_frames_are_enough(predictor, batch, truth, count):
    part = predict(predictor, Source(batch.rows(slice(0, count)), rate_hz=None))
    assert (part.state == State.OBSERVED).all()
    assert error(part, truth[:count]) < 40


def test_nan_and_absent_people_give_no_joint(predictor, batch):
    broken = batch.key_points.clone()
    broken[:, 1] = torch.nan
    valid = batch.valid.clone()
    valid[:, 0] = False
    valid[20:110] = False
    part = predict(predictor, Source(replace(batch, key_points=broken, valid=valid)))
    assert part.points.isfinite().all()
    assert not part.has_position[46:84].any()
    assert (part.state[10] == State.OBSERVED).all()


@pytest.mark.parametrize("factor", sizes.representatives([0.05], [1000.0]))
def test_a_body_of_any_size_is_followed(predictor, batch, result, factor):
    """A mouse, or a person before cameras of a wrong unit."""
    cameras = batch.cameras
    resized = replace(batch, cameras=Cameras(cameras.K, cameras.R, cameras.t * factor))
    part = predict(predictor, Source(resized))
    assert torch.equal(part.state, result.state)
    distance = (part.points / factor - result.points).norm(dim=-1)
    assert float(distance.max()) < 10
    assert float(distance.mean()) < 1


def test_the_solver_solves_the_equations():
    """Groups and conjugate gradients against the dense matrix."""
    generator = torch.Generator().manual_seed(1)
    joints, frames = 17, 9
    shape = (joints, frames)

    def normal(*size):
        return torch.randn(*size, generator=generator, dtype=torch.float64)

    bones = normal(3, len(BONES), frames)
    root = normal(3, 3, *shape)
    blocks = torch.einsum("abjt,cbjt->acjt", root, root)
    for bone, (start, end) in enumerate(BONES):
        outer = bones[:, None, bone] * bones[None, :, bone]
        blocks[:, :, start] += outer
        blocks[:, :, end] += outer
    upper = torch.stack([blocks[i, k] for i, k in UPPER])
    own = torch.full(shape, 7.0, dtype=torch.float64)
    near = torch.full(shape, -2.0, dtype=torch.float64)
    far = torch.full(shape, 0.5, dtype=torch.float64)
    right = normal(3, *shape)
    equations = NormalEquations(upper, right, TimeCoupling(own, near, far), bones)
    matrix = torch.zeros(3, joints, frames, 3, joints, frames, dtype=torch.float64)
    for joint in range(joints):
        for t in range(frames):
            matrix[:, joint, t, :, joint, t] = blocks[:, :, joint, t] + 7 * torch.eye(3)
            for step, value in ((1, -2.0), (2, 0.5)):
                if t + step < frames:
                    matrix[:, joint, t, :, joint, t + step] = value * torch.eye(3)
                    matrix[:, joint, t + step, :, joint, t] = value * torch.eye(3)
    for bone, (start, end) in enumerate(BONES):
        for t in range(frames):
            outer = torch.outer(bones[:, bone, t], bones[:, bone, t])
            matrix[:, start, t, :, end, t] = -outer
            matrix[:, end, t, :, start, t] = -outer
    size = 3 * joints * frames
    expected = torch.linalg.solve(matrix.reshape(size, size), right.reshape(size))
    near[:, -1:] = 0
    far[:, -2:] = 0
    for largest in (1, 5, 17):
        groups = body_groups(joints, BONES, largest)
        limit = ConjugateGradients(tolerance=1e-10, iterations=500)
        found = solve(equations, BONES, groups, torch.zeros_like(right), limit)
        assert torch.allclose(found.reshape(size), expected, atol=1e-7)


@pytest.mark.parametrize("count", [1, 2, 7, 12])
def test_blocks_of_an_inverse_are_those_of_the_whole_inverse(count):
    generator = torch.Generator().manual_seed(count)
    size = 3
    matrix = torch.zeros(count, size, count, size, dtype=torch.float64)
    rows = torch.randn(count, 2 * size, size, generator=generator, dtype=torch.float64)
    for block, two in enumerate(rows.unbind()):
        ends = (block, min(block + 1, count - 1))
        for one, part in zip(ends, two.split(size), strict=True):
            for other, beside in zip(ends, two.split(size), strict=True):
                matrix[one, :, other] += part @ beside.T + torch.eye(size) * (one == other)
    at = torch.arange(count)
    inverse = torch.linalg.inv(matrix.flatten(2).flatten(0, 1)).view_as(matrix)
    diagonal, upper = tridiagonal_inverse(matrix[at, :, at], matrix[at[:-1], :, at[1:]])
    torch.testing.assert_close(diagonal, inverse[at, :, at])
    torch.testing.assert_close(upper, inverse[at[:-1], :, at[1:]])


def test_groups_are_small_and_no_bone_joins_two_of_one_half():
    groups = body_groups(17, BONES, 5)
    halves = (groups.even, groups.odd)
    assert sorted(joint for half in halves for group in half for joint in group) == list(range(17))
    assert max(len(group) for half in halves for group in half) == 5
    half_of = {joint: i for i, half in enumerate(halves) for group in half for joint in group}
    for bone in groups.outer:
        start, end = BONES[bone]
        assert half_of[start] != half_of[end]
    assert sorted(groups.inner + groups.outer) == list(range(len(BONES)))


def test_a_bone_that_closes_a_circle_is_left_out():
    assert spanning_bones(4, ((0, 1), (1, 2), (2, 0), (2, 3))) == (0, 1, 3)


def test_the_limbs_are_the_arms_and_the_legs():
    names = [{HUMAN36M.key_points[joint] for joint in limb} for limb in sided_limbs(HUMAN36M)]
    legs = {f"{side}_{part}" for side in ("left", "right") for part in ("hip", "knee", "ankle")}
    arms = {
        f"{side}_{part}" for side in ("left", "right") for part in ("shoulder", "elbow", "wrist")
    }
    assert legs in names
    assert arms in names


def test_windows_cover_each_frame_once():
    frame = np.array([0, 2, 4, 6, 40, 42, 44, 130, 132])
    clock = Clock.of_frames(frame, 50.0, 0.5)
    assert clock.step == 2
    windows = list(Windows(10, 5).covering(frame, np.arange(9), clock))
    covered = [row for window in windows for row in window.rows[window.core]]
    assert covered == list(range(9))


def test_frames_that_are_left_out_are_places_without_an_observation():
    frame = np.array([3, 4, 7, 8, 100, 101])
    place, axis = Clock.of_frames(frame, 50.0, 0.5).axis(frame)
    assert place.tolist() == [0, 1, 4, 5, 6, 7]
    assert axis.joined.tolist() == [True] * 5 + [False, True, False]


def test_a_sample_is_of_successive_frames():
    rows = spread_runs(10_000, 300, 100)
    assert len(rows) == 300
    assert (np.diff(rows) == 1).sum() == 297


def test_an_inflation_makes_the_ellipsoids_hold():
    generator = torch.Generator().manual_seed(0)
    square = 6 * torch.randn(5000, 3, generator=generator).double().square().sum(-1)
    test = DisjointTest(square)
    assert test.inflation() == pytest.approx(6, rel=0.05)
    assert DisjointTest(square / test.inflation()).coverage()[1] == pytest.approx(0.9, abs=0.02)
