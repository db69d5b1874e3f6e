"""Millimetres per unit: the known length, a body height, measured segments."""

import math

import numpy as np
import pytest
import torch

from ghpt.calibration.millimetres import ScaleSettings, read_scale
from ghpt.data.synthetic import body
from ghpt.errors import GhptConfigError
from ghpt.geometry.cameras import Cameras
from ghpt.models.relative_pose.scale import (
    BONE_NAMES,
    BodyHeight,
    BoneLengths,
    KnownScale,
    average_lengths,
    body_scale,
    stature,
)
from ghpt.observations import RelativePoseEstimate
from ghpt.skeleton import BONES, JOINTS
from rigs_with_people import people, relative
from scenes import labelled_pairs


def bones(points):
    one, other = torch.tensor(BONES).T
    return (points[..., one, :] - points[..., other, :]).norm(dim=-1).median(-2).values


def batch(noise=0.0):
    scene = people(frames=20, noise=noise)
    pairs = torch.tensor([[0, 1], [2, 0]])
    two = lambda x: torch.stack((x, x))  # noqa: E731
    cameras = Cameras(two(scene.cameras.K), two(scene.cameras.R), two(scene.cameras.t))
    valid = two(scene.valid.transpose(0, 1))
    key_points = two(scene.key_points.transpose(0, 1))
    problem = labelled_pairs(cameras, pairs, key_points, valid).observations
    R, t = (
        torch.stack(x)
        for x in zip(*(relative(scene.cameras, *p) for p in pairs.tolist()), strict=True)
    )
    return problem, R, t, scene


def test_every_scale_finds_the_true_length():
    problem, R, t, scene = batch()
    length = t.norm(dim=-1)
    estimate = RelativePoseEstimate(R, t / length[:, None], torch.ones(2, dtype=torch.bool))
    true = bones(scene.points)
    segments = BoneLengths({BONE_NAMES[i]: float(true[i]) for i in (0, 1, 11)})
    torch.testing.assert_close(KnownScale()(estimate, problem), length)
    torch.testing.assert_close(segments(estimate, problem), length, rtol=1e-6, atol=0)
    height = float(stature(scene.points, torch.ones(scene.points.shape[:-1], dtype=torch.bool)))
    torch.testing.assert_close(BodyHeight(height)(estimate, problem), length, rtol=1e-6, atol=0)
    # twice the unit, half the scale; hypotheses as a second dimension
    many = RelativePoseEstimate(
        R[:, None].expand(-1, 3, -1, -1),
        torch.stack([k * t for k in (1, 2, 4)], 1),
        torch.ones(2, 3, dtype=torch.bool),
    )
    for scale in (KnownScale(), segments, BodyHeight(height)):
        expected = torch.tensor([1, 0.5, 0.25], dtype=torch.float64).expand(2, -1)
        torch.testing.assert_close(scale(many, problem), expected, rtol=1e-6, atol=0)


def test_a_joint_that_one_of_two_views_sees_measures_nothing():
    problem, R, t, scene = batch()
    length = t.norm(dim=-1)
    estimate = RelativePoseEstimate(R, t / length[:, None], torch.ones(2, dtype=torch.bool))
    segments = BoneLengths({BONE_NAMES[0]: float(bones(scene.points)[0])})
    end = BONES[0][0]
    problem.valid[:, 0, :15, end] = False
    problem.key_points[:, 0, :15, end] = 0
    torch.testing.assert_close(segments(estimate, problem), length, rtol=1e-6, atol=0)


def test_what_is_not_estimated_has_no_scale():
    problem, R, t, _ = batch()
    estimate = RelativePoseEstimate(R, t, torch.tensor([True, False]))
    for scale in (KnownScale(), BodyHeight(1750.0)):
        assert (scale(estimate, problem) > 0).tolist() == [True, False]


def test_body_scale_is_robust_and_masks():
    generator = torch.Generator().manual_seed(0)
    points = people(frames=41).points / 1000
    known = bones(points) * 1000
    valid = torch.ones(points.shape[:-1], dtype=torch.bool)
    assert body_scale(points, valid, known) == pytest.approx(1000)
    spoilt = points.clone()
    spoilt[:15] += torch.randn(15, 17, 3, generator=generator, dtype=torch.float64)
    masked = valid.clone()
    masked[:15] = False
    assert body_scale(spoilt, valid, known) == pytest.approx(1000, rel=0.05)
    assert body_scale(spoilt, masked, known) == pytest.approx(1000, rel=1e-2)
    unknown = known.clone()
    unknown[3:] = float("nan")
    unknown[2] = 0
    assert body_scale(points, valid, unknown) == pytest.approx(1000)
    assert body_scale(points, torch.zeros_like(valid), known) == 0
    assert body_scale(points, valid, torch.zeros_like(known)) == 0


def test_average_adult_is_the_median_of_many():
    lengths = torch.tensor(average_lengths(), dtype=torch.float64)
    assert (lengths > 0).sum() == 8
    heights = []
    for number in range(1000, 1060):
        person = body.random_body(np.random.default_rng(number))
        standing = torch.from_numpy(body.pose(person, np.zeros((1, len(body.SEGMENTS), 3))))
        heights.append(
            float(stature(standing, torch.ones(1, 17, dtype=torch.bool))) / person.stature
        )
    assert np.median(heights) == pytest.approx(1, abs=0.01)
    assert np.abs(np.array(heights) - 1).max() < 0.1


def test_segments_have_names_on_both_sides():
    assert len(set(BONE_NAMES)) == len(BONES)
    for name, ends in zip(BONE_NAMES, BONES, strict=True):
        if name.endswith("thigh"):
            side = name.split("_")[0]
            assert {JOINTS[j] for j in ends} == {f"{side}_knee", f"{side}_hip"}
    both = dict(
        zip(BONE_NAMES, BoneLengths({"thigh": 430.0, "left_forearm": 250.0}).lengths, strict=True)
    )
    assert {name for name, mm in both.items() if mm} == {
        "right_thigh",
        "left_thigh",
        "left_forearm",
    }


@pytest.mark.parametrize("lengths", [{}, {"tail": 300.0}, {"thigh": 0.0}, {"thigh": -1.0}])
def test_bad_lengths_are_named(lengths):
    with pytest.raises(GhptConfigError, match="lengths"):
        BoneLengths(lengths)


def test_bad_height_is_named():
    with pytest.raises(GhptConfigError, match="mm"):
        BodyHeight(0.0)


def scale(**given):
    return read_scale(ScaleSettings(**given), "ab")


@pytest.mark.parametrize(
    ("given", "mm"), [(1750, 1750.0), (1.75, 1750.0), (175, 1750.0), (1.1, 1100.0), (205.0, 2050.0)]
)
def test_a_height_in_metres_or_centimetres_is_taken_for_one(given, mm):
    assert scale(height=given).mm == pytest.approx(mm)
    assert scale(assumed_height=given).mm == pytest.approx(mm)


@pytest.mark.parametrize("given", [-1, 0, math.nan, math.inf, 17500, 5.9, 69, 17.5, 0.175, True])
@pytest.mark.parametrize("key", ["height", "assumed_height"])
def test_a_height_that_is_nobodys_is_an_error(key, given):
    with pytest.raises(GhptConfigError, match=rf"scale\.{key}: is .*1750"):
        scale(**{key: given})


@pytest.mark.parametrize(
    ("given", "mm"),
    [
        ({"thigh": 430, "forearm": 250}, 430.0),
        ({"thigh": 43, "forearm": 25.0}, 430.0),
        ({"thigh": 0.43}, 430.0),
    ],
)
def test_segments_are_all_of_one_unit(given, mm):
    assert scale(segments=given).mm["thigh"] == pytest.approx(mm)


@pytest.mark.parametrize(
    "given",
    [
        {"thigh": 430, "forearm": 0.25},
        {"thigh": 4.3},
        {"thigh": 4300},
        {"thigh": -43},
        {"thigh": math.nan},
    ],
)
def test_segments_that_are_nobodys_are_an_error(given):
    with pytest.raises(GhptConfigError, match=r"scale\.segments"):
        scale(segments=given)


@pytest.mark.parametrize(("given", "mm"), [(3000, 3000.0), (3.2, 3200.0), (0.4, 400.0)])
def test_a_baseline_in_metres_is_taken_for_one(given, mm):
    source = scale(baseline=["a", "b", given])
    assert source.names == ("a", "b")
    assert source.mm == pytest.approx(mm)


@pytest.mark.parametrize("given", [30, 100, 0.01, -3, math.nan, "3000"])
def test_a_baseline_that_could_be_of_any_unit_is_an_error(given):
    with pytest.raises(GhptConfigError, match=r"scale\.baseline"):
        scale(baseline=["a", "b", given])
