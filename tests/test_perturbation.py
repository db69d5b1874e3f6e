"""Perturbations: what they change is what was asked, nothing else, and the same for whoever
looks."""

from dataclasses import fields, replace

import pytest
import torch

from ghpt.errors import GhptConfigError
from ghpt.geometry.rotations import is_rotation, matrix_to_vector
from ghpt.models.estimators.classical import Linear, person_scale
from ghpt.observations import Observations
from ghpt.paper.robustness.perturbation import (
    FewerCameras,
    FlippedViews,
    MissingDetections,
    MissingViews,
    Noise,
    OtherPeople,
    Outliers,
    Perturbation,
    RotatedCameras,
    ShiftedCameras,
)
from ghpt.skeleton import PELVIS
from scenes import random_scene

SEED = 3
NOTHING = {
    "outliers": Outliers(0.0, 0.1, 0.5),
    "flips": FlippedViews(0.0, 5),
    "people": OtherPeople(0.0, 5, 400, 1500),
    "noise": Noise(0.0),
    "detections": MissingDetections(0.0),
    "views": MissingViews(0),
    "rotation": RotatedCameras(0.0),
    "shift": ShiftedCameras(0.0),
}
SOMETHING = {
    "outliers": Outliers(0.3, 0.1, 0.5),
    "lasting": Outliers(0.3, 0.1, 0.5, frames=5),
    "flips": FlippedViews(0.3, 5),
    "people": OtherPeople(0.3, 5, 400, 1500),
    "noise": Noise(0.02),
    "detections": MissingDetections(0.3),
    "views": MissingViews(2),
    "cameras": FewerCameras(3),
    "rotation": RotatedCameras(1.0),
    "shift": ShiftedCameras(20.0),
}


def a_batch(frames: int = 40, views: int = 5) -> Observations:
    """A tenth of the detections not seen, and nonsense in their place."""
    scene = random_scene(0, frames, views)
    valid = torch.rand(frames, views, 17, generator=torch.Generator().manual_seed(1)) > 0.1
    batch = scene.batch(valid)
    key_points = torch.where(valid[..., None], batch.key_points, -7.0)
    return replace(batch, key_points=key_points, recording=torch.arange(frames))


def tensors(batch: Observations) -> dict[str, torch.Tensor]:
    own = {f.name: getattr(batch, f.name) for f in fields(batch) if f.name != "cameras"}
    return own | {name: getattr(batch.cameras, name) for name in ("K", "R", "t")}


def moved(before: Observations, after: Observations) -> torch.Tensor:
    """How far each seen key point went, in the person's size."""
    size = person_scale(before.key_points, before.valid)[..., None]
    return torch.where(
        before.valid, (after.key_points - before.key_points).norm(dim=-1) / size, 0.0
    )


@pytest.mark.parametrize("perturbation", NOTHING.values(), ids=NOTHING)
def test_level_zero_changes_nothing(perturbation: Perturbation) -> None:
    batch = a_batch()
    after = tensors(perturbation(batch, SEED))
    assert all(torch.equal(after[name], value) for name, value in tensors(batch).items())


@pytest.mark.parametrize("perturbation", SOMETHING.values(), ids=SOMETHING)
def test_a_frame_is_the_same_in_any_batch_and_differs_from_others(
    perturbation: Perturbation,
) -> None:
    batch = a_batch()
    rows = torch.tensor([31, 4, 17])
    few = batch.rows(rows)
    whole, part = tensors(perturbation(batch, SEED)), tensors(perturbation(few, SEED))
    other = tensors(perturbation(batch, SEED + 1))
    assert all(torch.equal(whole[name][rows], part[name]) for name in whole)
    assert any(not torch.equal(whole[name], other[name]) for name in whole)


@pytest.mark.parametrize("perturbation", SOMETHING.values(), ids=SOMETHING)
def test_what_is_unseen_stays_unseen(perturbation: Perturbation) -> None:
    batch = a_batch()
    batch = replace(batch, valid=torch.zeros_like(batch.valid))
    after = perturbation(batch, SEED)
    assert not after.valid.any()
    assert torch.isin(after.key_points, batch.key_points).all()


def test_outliers_are_as_many_and_as_far_as_asked_and_nested() -> None:
    batch = a_batch(frames=200)
    off = {rate: moved(batch, Outliers(rate, 0.1, 0.5)(batch, SEED)) for rate in (0.1, 0.2)}
    for rate, distance in off.items():
        hit = distance[batch.valid] > 0
        assert hit.double().mean().item() == pytest.approx(rate, abs=0.01)
        assert distance[batch.valid][hit].min() >= 0.1 - 1e-9
        assert distance.max() <= 0.5 + 1e-9
        assert distance[batch.valid][hit].mean().item() == pytest.approx(0.3, abs=0.01)
    less = off[0.1] > 0
    assert torch.equal(off[0.2][less], off[0.1][less])


@pytest.mark.parametrize("name", ["lasting", "flips", "people"])
def test_what_lasts_is_the_same_in_successive_frames(name: str) -> None:
    batch = replace(a_batch(), valid=torch.ones(40, 5, 17, dtype=torch.bool))
    hit = (SOMETHING[name](batch, SEED).key_points != batch.key_points).any(-1)
    by_block = hit.unflatten(0, (8, 5))
    assert (by_block == by_block[:, :1]).double().mean() > 0.99
    assert by_block.any(-1).double().mean() > 0.1
    assert not (by_block == by_block[:1]).all()


def test_all_views_show_the_same_other_person_as_far_away_as_asked() -> None:
    scene = random_scene(0, 20, 5)
    batch = scene.batch(torch.ones(20, 5, 17, dtype=torch.bool))
    changed = OtherPeople(1.0, 1, 400, 1500)(batch, SEED)
    before = Linear().triangulate(batch)
    after = Linear().triangulate(changed)
    both = before.ok & after.ok
    assert both.double().mean() > 0.5
    offset = (after.points - before.points)[:, PELVIS]
    distance = offset[both[:, PELVIS], :2].norm(dim=-1)
    assert distance.min() > 399
    assert distance.max() < 1501
    torch.testing.assert_close(
        offset[both[:, PELVIS], 2], torch.zeros_like(distance), atol=1.0, rtol=0
    )


def test_noise_has_the_deviation_asked_in_each_coordinate_and_only_grows() -> None:
    batch = a_batch(frames=200)
    size = person_scale(batch.key_points, batch.valid)[..., None, None]
    small, large = (
        ((Noise(s)(batch, SEED).key_points - batch.key_points) / size)[batch.valid]
        for s in (0.01, 0.03)
    )
    assert small.std(dim=0).tolist() == pytest.approx([0.01, 0.01], rel=0.03)
    assert small.mean(dim=0).tolist() == pytest.approx([0, 0], abs=3e-4)
    assert torch.corrcoef(small.mT)[0, 1].abs() < 0.03
    assert torch.allclose(large, 3 * small)


def test_missing_detections_are_as_many_as_asked_and_nested() -> None:
    batch = a_batch(frames=200)
    left = {rate: MissingDetections(rate)(batch, SEED).valid for rate in (0.2, 0.4, 1.0)}
    for rate, valid in left.items():
        assert (valid.sum() / batch.valid.sum()).item() == pytest.approx(1 - rate, abs=0.01)
        assert not (valid & ~batch.valid).any()
    assert not (left[0.4] & ~left[0.2]).any()


def test_whole_views_are_missing_any_of_them_and_nested() -> None:
    batch = replace(a_batch(frames=400), valid=torch.ones(400, 5, 17, dtype=torch.bool))
    one, two = (MissingViews(n)(batch, SEED).valid for n in (1, 2))
    for count, valid in ((1, one), (2, two)):
        views = valid.any(-1)
        assert torch.equal(views, valid.all(-1))
        assert (views.sum(-1) == 5 - count).all()
        assert views.double().mean(0).tolist() == pytest.approx([1 - count / 5] * 5, abs=0.08)
    assert not (two & ~one).any()
    assert not MissingViews(5)(batch, SEED).valid.any()


def test_fewer_cameras_come_with_their_own_key_points_and_are_nested() -> None:
    batch = a_batch()
    all_of_them, three, two = (FewerCameras(n)(batch, SEED) for n in (5, 3, 2))
    assert three.key_points.shape == (40, 3, 17, 2)
    for name, value in tensors(two).items():
        if name in ("key_points", "confidence", "valid", "K", "R", "t"):
            assert torch.equal(value, tensors(three)[name][:, :2])
    place = (
        (batch.cameras.t[:, None] == all_of_them.cameras.t[:, :, None]).all(-1).long().argmax(-1)
    )
    assert (place.sort(-1).values == torch.arange(5)).all()
    rows = torch.arange(40)[:, None]
    assert torch.equal(batch.key_points[rows, place], all_of_them.key_points)
    assert torch.equal(batch.valid[rows, place], all_of_them.valid)


def test_cameras_turn_by_the_angle_asked_about_their_own_centre() -> None:
    batch = a_batch()
    small, large = (RotatedCameras(degrees)(batch, SEED).cameras for degrees in (0.5, 2.0))
    turns = {}
    for degrees, cameras in ((0.5, small), (2.0, large)):
        assert is_rotation(cameras.R, 1e-12).all()
        torch.testing.assert_close(cameras.centre, batch.cameras.centre, atol=1e-8, rtol=0)
        turns[degrees] = matrix_to_vector(cameras.R @ batch.cameras.R.mT)
        angle = turns[degrees].norm(dim=-1)
        torch.testing.assert_close(
            angle, torch.deg2rad(torch.full_like(angle, degrees)), atol=1e-10, rtol=0
        )
    torch.testing.assert_close(turns[2.0], 4 * turns[0.5], atol=1e-10, rtol=0)
    assert (turns[2.0] / turns[2.0].norm(dim=-1, keepdim=True)).mean(dim=(0, 1)).abs().max() < 0.15


def test_cameras_shift_by_the_length_asked_and_keep_their_direction() -> None:
    batch = a_batch()
    cameras = ShiftedCameras(20.0)(batch, SEED).cameras
    shift = cameras.centre - batch.cameras.centre
    torch.testing.assert_close(shift.norm(dim=-1), torch.full((40, 5), 20.0, dtype=torch.float64))
    assert torch.equal(cameras.R, batch.cameras.R)
    assert shift.mean(dim=(0, 1)).abs().max() < 3


def test_a_share_is_between_0_and_1() -> None:
    for wrong in (lambda: Outliers(1.2, 0.1, 0.5), lambda: MissingDetections(-0.1)):
        with pytest.raises(GhptConfigError, match="share between 0 and 1"):
            wrong()
