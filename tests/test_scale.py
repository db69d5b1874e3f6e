"""Millimetres per unit: the known length, a body height, measured segments."""

import numpy as np
import pytest
import torch

from ghpt.data import body
from ghpt.errors import GhptConfigError
from ghpt.geometry.cameras import Cameras
from ghpt.models.scale import SEGMENTS, BodyHeight, KnownScale, SegmentLengths, average_lengths, body_scale, stature
from ghpt.recording import PairBatch, RelativePoseEstimate
from ghpt.skeleton import BONES, JOINTS
from rigs_with_people import people, relative


def bones(points):
    one, other = torch.tensor(BONES).T
    return (points[..., one, :] - points[..., other, :]).norm(dim=-1).median(-2).values


def batch(noise=0.0):
    scene = people(frames=20, noise=noise)
    pairs = torch.tensor([[0, 1], [2, 0]])
    two = lambda x: torch.stack((x, x))  # noqa: E731
    cameras = Cameras(two(scene.cameras.K), two(scene.cameras.R), two(scene.cameras.t))
    seen = two(scene.seen.transpose(0, 1))
    problem = PairBatch(
        sample=torch.arange(2), rig=torch.zeros(2, dtype=torch.int64), draw=torch.zeros(2, dtype=torch.int64),
        pair=pairs, cameras=cameras, key_points=two(scene.key_points.transpose(0, 1)),
        confidence=torch.ones(seen.shape), seen=seen, points=torch.zeros(2, 1, 3, dtype=torch.float64),
    )  # fmt: skip
    R, t = (torch.stack(x) for x in zip(*(relative(scene.cameras, *p) for p in pairs.tolist()), strict=True))
    return problem, R, t, scene


def test_every_scale_finds_the_true_length():
    problem, R, t, scene = batch()
    length = t.norm(dim=-1)
    estimate = RelativePoseEstimate(R, t / length[:, None], torch.ones(2, dtype=torch.bool))
    true = bones(scene.points)
    segments = SegmentLengths({SEGMENTS[i]: float(true[i]) for i in (0, 1, 11)})
    torch.testing.assert_close(KnownScale()(estimate, problem), length)
    torch.testing.assert_close(segments(estimate, problem), length, rtol=1e-6, atol=0)
    height = float(stature(scene.points, torch.ones(scene.points.shape[:-1], dtype=torch.bool)))
    torch.testing.assert_close(BodyHeight(height)(estimate, problem), length, rtol=1e-6, atol=0)
    # twice the unit, half the scale; hypotheses as a second dimension
    many = RelativePoseEstimate(
        R[:, None].expand(-1, 3, -1, -1), torch.stack([k * t for k in (1, 2, 4)], 1), torch.ones(2, 3, dtype=torch.bool)
    )
    for scale in (KnownScale(), segments, BodyHeight(height)):
        expected = torch.tensor([1, 0.5, 0.25], dtype=torch.float64).expand(2, -1)
        torch.testing.assert_close(scale(many, problem), expected, rtol=1e-6, atol=0)


def test_a_joint_that_one_of_two_views_sees_measures_nothing():
    problem, R, t, scene = batch()
    length = t.norm(dim=-1)
    estimate = RelativePoseEstimate(R, t / length[:, None], torch.ones(2, dtype=torch.bool))
    segments = SegmentLengths({SEGMENTS[0]: float(bones(scene.points)[0])})
    end = BONES[0][0]
    problem.seen[:, 0, :15, end] = False
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
    seen = torch.ones(points.shape[:-1], dtype=torch.bool)
    assert body_scale(points, seen, known) == pytest.approx(1000)
    spoilt = points.clone()
    spoilt[:15] += torch.randn(15, 17, 3, generator=generator, dtype=torch.float64)
    masked = seen.clone()
    masked[:15] = False
    assert body_scale(spoilt, seen, known) == pytest.approx(1000, rel=0.05)
    assert body_scale(spoilt, masked, known) == pytest.approx(1000, rel=1e-2)
    unknown = known.clone()
    unknown[3:] = float("nan")
    unknown[2] = 0
    assert body_scale(points, seen, unknown) == pytest.approx(1000)
    assert body_scale(points, torch.zeros_like(seen), known) == 0
    assert body_scale(points, seen, torch.zeros_like(known)) == 0


def test_average_adult_is_the_median_of_many():
    lengths = torch.tensor(average_lengths(), dtype=torch.float64)
    assert (lengths > 0).sum() == 8
    heights = []
    for number in range(1000, 1060):
        person = body.random_body(np.random.default_rng(number))
        standing = torch.from_numpy(body.pose(person, np.zeros((1, len(body.SEGMENTS), 3))))
        heights.append(float(stature(standing, torch.ones(1, 17, dtype=torch.bool))) / person.stature)
    assert np.median(heights) == pytest.approx(1, abs=0.01)
    assert np.abs(np.array(heights) - 1).max() < 0.1


def test_segments_have_names_on_both_sides():
    assert len(set(SEGMENTS)) == len(BONES)
    for name, ends in zip(SEGMENTS, BONES, strict=True):
        if name.endswith("thigh"):
            side = name.split("_")[0]
            assert {JOINTS[j] for j in ends} == {f"{side}_knee", f"{side}_hip"}
    both = dict(zip(SEGMENTS, SegmentLengths({"thigh": 430.0, "left_forearm": 250.0}).lengths, strict=True))
    assert {name for name, mm in both.items() if mm} == {"right_thigh", "left_thigh", "left_forearm"}


@pytest.mark.parametrize("lengths", [{}, {"tail": 300.0}, {"thigh": 0.0}, {"thigh": -1.0}])
def test_bad_lengths_are_named(lengths):
    with pytest.raises(GhptConfigError, match="lengths"):
        SegmentLengths(lengths)


def test_bad_height_is_named():
    with pytest.raises(GhptConfigError, match="mm"):
        BodyHeight(0.0)
