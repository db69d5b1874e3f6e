import numpy as np
import pytest
import torch

from ghpt.data.datasets.frames import BatchOrder, Frames, trainable
from ghpt.geometry.cameras import Cameras
from ghpt.observations import LabelledRecording
from ghpt.skeleton import PELVIS


def recording(name, frames, offset, views=3):
    rng = np.random.default_rng(len(name))
    return LabelledRecording(
        name=name,
        subject="S1",
        action="Walking",
        rate_hz=50.0,
        camera_names=tuple("abc"[:views]),
        cameras=Cameras(
            torch.eye(3, dtype=torch.float64).expand(views, 3, 3) + offset,
            torch.eye(3, dtype=torch.float64).expand(views, 3, 3),
            torch.zeros(views, 3, dtype=torch.float64),
        ),
        key_points=rng.random((frames, views, 17, 2), dtype=np.float32),
        confidence=np.ones((frames, views, 17), np.float32),
        valid=rng.random((frames, views, 17)) > 0.2,
        truth=rng.random((frames, 17, 3), dtype=np.float32),
        truth_valid=np.ones((frames, 17), bool),
        frame=np.arange(frames) * 10 + offset,
    )


@pytest.fixture
def recordings():
    return [recording("one", 5, 0), recording("two", 1, 100), recording("three", 7, 200)]


def test_a_batch_is_its_frames(recordings):
    frames = Frames(recordings, np.array([12, 0, 5, 6, 4]))
    batch = frames[range(5)]
    places = [(2, 6), (0, 0), (1, 0), (2, 0), (0, 4)]
    for row, (r, t) in enumerate(places):
        assert batch.observations.recording[row] == r
        for field in ("key_points", "confidence", "valid"):
            np.testing.assert_array_equal(
                getattr(batch.observations, field)[row], getattr(recordings[r], field)[t]
            )
        np.testing.assert_array_equal(batch.truth.points[row], recordings[r].truth[t])
        np.testing.assert_array_equal(batch.truth.valid[row], recordings[r].truth_valid[t])
        assert torch.equal(batch.observations.cameras.K[row], recordings[r].cameras.K)
    np.testing.assert_array_equal(
        frames.frame_numbers(range(5)), [recordings[r].frame[t] for r, t in places]
    )
    assert len(frames[[]]) == 0
    assert frames[[]].observations.key_points.shape == (0, 3, 17, 2)


def test_trainable_needs_the_pelvis_and_enough_joints(recordings):
    first = recordings[0]
    first.valid[:] = True
    first.valid[1, 1:] = False  # one view only
    first.valid[2, 1:, PELVIS] = False
    first.truth_valid[3, :6] = False
    frames = np.arange(5)
    assert trainable(recordings, frames, 12).tolist() == [True, False, False, False, True]
    assert trainable(recordings, frames, 11).tolist() == [True, False, False, True, True]


@pytest.mark.parametrize("count", [97, 96, 5, 1])
@pytest.mark.parametrize("world", [1, 2, 3])
def test_every_sample_once_in_the_same_global_batches_on_any_number_of_processes(count, world):
    orders = [
        list(BatchOrder(count, 16, rank, world, seed=3, done=lambda: 0)) for rank in range(world)
    ]
    alone = list(BatchOrder(count, 16, 0, 1, seed=3, done=lambda: 0))
    assert {len(o) for o in orders} == {len(alone)}
    for batch, *shares in zip(alone, *orders, strict=True):
        assert sorted(batch) == sorted(s for share in shares for s in share)
    assert sorted(s for batch in alone for s in batch) == list(range(count))


def test_the_order_goes_on_where_training_stopped():
    whole = [
        batch for epoch in range(3) for batch in BatchOrder(40, 16, 0, 1, 5, lambda e=epoch: 3 * e)
    ]
    assert whole[:3] != whole[3:6]
    for done in range(9):
        rest = list(BatchOrder(40, 16, 0, 1, 5, lambda d=done: d))
        assert rest == whole[done : 3 * (done // 3 + 1)]


def test_without_a_seed_the_order_is_the_data_sets():
    assert list(BatchOrder(5, 2, 0, 1, None, lambda: 0)) == [[0, 1], [2, 3], [4]]
