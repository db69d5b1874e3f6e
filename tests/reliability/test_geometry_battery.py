"""C4, C5, D1, D2 and D3 of the scorecard: geometry on exact, degenerate and broken input."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import sizes
from degenerate import (
    DEGENERATE,
    ONE_BAD_VIEW,
    S,
    cut,
    degenerate,
    ones,
    put,
)
from ghpt.geometry.cameras import Cameras, project
from ghpt.geometry.lens import distort, undistort
from ghpt.geometry.subsets import random_subsets
from ghpt.geometry.triangulation import triangulate, triangulate_subsets
from ghpt.models.estimators.classical import Linear, MEstimator, WeightedLinear
from ghpt.models.estimators.lo_ransac import LoRansac
from ghpt.models.estimators.ransac import Ransac
from ghpt.randomness import key
from scenes import Scene, random_scene

BASELINES = {
    "linear": Linear(),
    "weighted_linear": WeightedLinear(power=2.0),
    "ransac": Ransac(threshold=0.02, pairs=100, seed=0),
    "ransac_random": Ransac(threshold=0.02, pairs=2, seed=0),
    "m_estimator": MEstimator(loss="cauchy", scale=0.005, iterations=5, tolerance=0.1),
    "lo_ransac": LoRansac(threshold=0.02, seed=0),
}


def random_lens(rng, frames, views, count):
    size = np.array([0.15, 0.05, 2e-3, 2e-3, 0.02, 0.1, 0.05, 0.02])[:count]
    return torch.from_numpy(rng.uniform(-size, size, (frames, views, count)))


def test_d1_exact_key_points_through_any_lens_give_the_truth(record_row):
    rigs = sizes.LENSES
    worst = 0.0
    missing = 0
    good = 0
    rng = np.random.default_rng(0)
    for seed in range(25):
        views, scale = int(rng.integers(2, 17)), 10.0 ** rng.uniform(-4.5, 1.5)
        scene = random_scene(seed, rigs // 25, views, scale, place=float(rng.choice([0, 1e4, 1e5])))
        lens = random_lens(rng, rigs // 25, views, (4, 5, 8)[seed % 3])
        ideal, exists = undistort(
            distort(scene.key_points, scene.cameras.K, lens), scene.cameras.K, lens
        )
        result = triangulate(scene.cameras, ideal, exists.double())
        missing += int((~result.ok).sum())
        error = (result.points - scene.points).norm(dim=-1).amax(-1) / (6000 * scale)
        good += int((error <= 1e-9).sum())
        worst = max(worst, float(error.max()))
    record_row("D1", f"largest error {worst:.1e} of the scene's size over {rigs} rigs", good, rigs)
    assert missing == 0
    assert worst <= 1e-9


@pytest.fixture(scope="module")
def thousand():
    scene = cut(random_scene(0, 1000, 4), 3).noisy(2, 0)
    return scene, ones(scene)


def test_d2_degenerate_frames_have_the_right_status_and_spoil_no_other(thousand, record_row):
    large, weights = thousand
    good = triangulate(large.cameras, large.key_points, weights)
    others = torch.arange(1000) != 500
    wrong = []
    for name, (_, status) in DEGENERATE.items():
        scene, own = degenerate(name)
        alone = triangulate(scene.cameras, scene.key_points, own)
        mixed, all_weights = put(large, weights, 500, scene, own)
        result = triangulate(mixed.cameras, mixed.key_points, all_weights)
        for points, found in (
            (alone.points, alone.status),
            (result.points[500], result.status[500]),
        ):
            right = (found == status).all() and torch.isfinite(points).all()
            right = right and (
                (points - scene.points).abs().max() < 1e-3 * scene.points.abs().max()
                if status == S.OBSERVED
                else (points == 0).all()
            )
            if not right:
                wrong.append((name, found.tolist(), points.tolist()))
        for field in ("points", "status", "angle", "depth_min", "cond"):
            if not torch.equal(getattr(result, field)[others], getattr(good, field)[others]):
                wrong.append((name, field, "of neighbours changed"))
            if getattr(result, field).isnan().any():
                wrong.append((name, field, "is NaN"))
    total = 2 * len(DEGENERATE)
    record_row(
        "D2", f"triangulate: {len(DEGENERATE)} cases, alone and in 1,000", total - len(wrong), total
    )
    assert not wrong


def test_d2_no_point_is_found_in_a_camera_s_own_centre(record_row):
    """Where rays meet in a camera's centre the depth is rounding, of either sign: many times, never
    ok.
    """
    scene = random_scene(1, 300, 2, place=1e4)
    doubled = scene.cameras.index((slice(None), [0, 0]))
    noise = np.random.default_rng(1).normal(0, 5, tuple(scene.key_points.shape))
    inside = project(scene.cameras, scene.cameras.centre[:, :1].expand(-1, 17, -1))[0]
    inside[:, 0] = scene.key_points[:, 0]
    twice = scene.key_points[:, [0, 0]] + torch.from_numpy(noise)
    accepted = 0
    for cameras, key_points in ((doubled, twice), (scene.cameras, inside)):
        accepted += int(triangulate(cameras, key_points, ones(scene)).ok.sum())
        valid = torch.ones(key_points.shape[:-1], dtype=torch.bool)
        accepted += int(triangulate_subsets(cameras, key_points, valid, valid.mT[:, None])[1].sum())
    total = 4 * 300 * 17
    record_row("D2", "points in a camera's own centre", total - accepted, total)
    assert accepted == 0


def test_d2_subsets_refuse_degenerate_frames_and_spoil_no_other(record_row):
    large = cut(random_scene(0, 100, 4), 3).noisy(2, 0)
    wrong = []
    for hypotheses in (10, 40):  # solved one by one, and looked up
        keys = key(0, "battery", torch.arange(100))
        valid = torch.ones(large.key_points.shape[:-1], dtype=torch.bool)
        subsets = random_subsets(valid, hypotheses, keys)
        others = torch.arange(100) != 50
        good, _ = triangulate_subsets(large.cameras, large.key_points, valid, subsets)
        for name, (_, status) in DEGENERATE.items():
            if "weight" in name:
                continue
            scene, own = degenerate(name)
            mixed, visible = put(large, valid, 50, scene, own > 0)
            subsets[50] = (own > 0).mT
            points, ok = triangulate_subsets(mixed.cameras, mixed.key_points, visible, subsets)
            if ok[50].any() != (status == S.OBSERVED) or ok[50].all() != (status == S.OBSERVED):
                wrong.append((hypotheses, name))
            if not torch.isfinite(points).all() or not torch.equal(points[others], good[others]):
                wrong.append((hypotheses, name, "neighbours"))
    total = 2 * sum("weight" not in name for name in DEGENERATE)
    record_row("D2", "triangulate_subsets, both ways", total - len(wrong), total)
    assert not wrong


@pytest.mark.parametrize("name", BASELINES)
def test_d2_classical_estimators_invent_nothing_and_spoil_no_other(name, record_row):
    frames = sizes.ESTIMATED_FRAMES
    large = cut(random_scene(0, frames, 4), 3).noisy(2, 0)
    valid = torch.ones(large.key_points.shape[:-1], dtype=torch.bool)
    good = BASELINES[name](large.batch())
    others = torch.arange(frames) != 50
    wrong = []
    for case, (_, status) in DEGENERATE.items():
        if "weight" in case:
            continue
        scene, own = degenerate(case)
        mixed, visible = put(large, valid, 50, scene, own > 0)
        estimate = BASELINES[name](mixed.batch(visible))
        # with one bad view of four a robust estimator may go on without it; behind a camera it may
        # leave that out
        undefined = status in (S.FEW_VIEWS, S.PARALLEL) or case in (
            "all zero",
            "diverging rays",
            "behind all",
        )
        if undefined and estimate.estimated[50].any():
            wrong.append((case, "invented"))
        if status == S.OBSERVED and not estimate.estimated[50].all():
            wrong.append((case, "left out"))
        if case in ONE_BAD_VIEW and estimate.estimated[50].any():
            error = (estimate.points - mixed.points)[50].norm(dim=-1)[estimate.estimated[50]]
            if error.max() > 1:
                wrong.append((case, "used the bad view"))
        if not torch.isfinite(estimate.points).all() or not torch.equal(
            estimate.points[others], good.points[others]
        ):
            wrong.append((case, "neighbours"))
    total = sum("weight" not in case for case in DEGENERATE)
    record_row(
        "D2",
        f"{name}: {total} cases in a batch of {frames}",
        total - len({w[0] for w in wrong}),
        total,
    )
    assert not wrong


BROKEN = [torch.nan, torch.inf, -torch.inf, 0.0, -0.0, 1e200, -1e308, 1e-310, 1e13]
SIZES = {"K": (3, 3), "R": (3, 3), "t": (3,), "key_points": (5, 2), "weights": (5,)}
tally = {"examples": 0}
noisy_scene = cache(lambda seed, views: cut(random_scene(seed, 2, views), 5).noisy(2, seed))


@settings(
    max_examples=sizes.BROKEN_NUMBERS,
    deadline=None,
    derandomize=True,
    suppress_health_check=list(HealthCheck),
)
@given(
    slot=st.sampled_from(list(SIZES)),
    value=st.sampled_from(BROKEN),
    place=st.tuples(*[st.integers(0, 1000)] * 4),
    density=st.floats(0, 1),
    views=st.integers(2, 5),
    seed=st.integers(0, 9),
)
def test_d3_a_broken_number_changes_only_what_is_made_of_it(
    slot, value, place, density, views, seed
):
    scene = noisy_scene(seed, views)
    weights = (
        torch.rand(2, views, 5, generator=torch.Generator().manual_seed(seed)) < density
    ).double()
    inputs = {f: getattr(scene.cameras, f).clone() for f in ("K", "R", "t")}
    inputs |= {"key_points": scene.key_points.clone(), "weights": weights.clone()}
    frame, view = place[0] % 2, place[1] % views
    inner = tuple(p % n for p, n in zip(place[2:], SIZES[slot], strict=False))
    inputs[slot][(frame, view, *inner)] = value
    key_points = inputs["key_points"].requires_grad_()
    cameras = Cameras(inputs["K"], inputs["R"], inputs["t"])
    before = triangulate(scene.cameras, scene.key_points, weights)
    after = triangulate(cameras, key_points, inputs["weights"])

    touched = torch.zeros(2, 5, dtype=torch.bool)
    touched[frame, inner[0] if slot in ("key_points", "weights") else slice(None)] = True
    if (
        slot != "weights"
    ):  # of a view that is not used nothing matters but where the camera places the origin
        touched[frame] &= weights[frame, view] > 0
    same = ~touched
    assert torch.equal(before.status[same], after.status[same])
    if slot in ("key_points", "weights"):
        assert torch.equal(before.points[same], after.points[same])
    else:
        outside = torch.arange(2) != frame
        assert torch.equal(before.points[outside], after.points[outside])
        torch.testing.assert_close(before.points[same], after.points[same], rtol=0, atol=1e-6)
    for field in (after.points, after.angle, after.depth_min):
        assert torch.isfinite(field).all()
    assert not after.cond.isnan().any()
    after.points.sum().backward()
    assert torch.isfinite(key_points.grad).all()
    assert (key_points.grad[inputs["weights"] == 0] == 0).all()

    tally["examples"] += 1
    if slot == "weights":  # subsets have none
        return
    used = weights > 0
    points, ok = triangulate_subsets(cameras, key_points.detach(), used, used.mT[:, None])
    assert torch.equal(
        ok[:, 0] | (after.status == S.BAD_INPUT),
        after.ok | (after.status == S.BAD_INPUT),
    )
    assert torch.isfinite(points).all()


def test_d3_is_recorded(record_row):
    if not tally["examples"]:
        pytest.skip("the fuzzing itself did not run")
    record_row(
        "D3",
        "broken number in any slot, random masks, gradients",
        tally["examples"],
        tally["examples"],
    )
    assert tally["examples"] >= sizes.BROKEN_NUMBERS


def everything(scene, valid):
    """All geometry of a batch, as a list of tensors with the frames first."""
    result = triangulate(scene.cameras, scene.key_points, valid.double())
    keys = key(5, "battery", scene.points[:, 0, 0].view(torch.int64))
    few, many = (random_subsets(valid, n, keys) for n in (20, 200))
    found = [result.points, result.status, result.angle, result.depth_min, few, many]
    for subsets in (few, many):
        found += triangulate_subsets(scene.cameras, scene.key_points, valid, subsets)
    batch = replace(scene.batch(valid), index=keys)
    for name in ("linear", "ransac_random", "m_estimator"):
        estimate = BASELINES[name](batch)
        found += [estimate.points, estimate.estimated]
    return found


@pytest.mark.parametrize("views", [3, 7, 31])
def test_c4_a_frame_s_geometry_is_the_same_in_any_batch_on_any_threads(views, record_row):
    count = sizes.SCENE_FRAMES
    scene = random_scene(views, count, views).noisy(2, 0)
    valid = (
        torch.rand(scene.key_points.shape[:-1], generator=torch.Generator().manual_seed(0)) < 0.8
    )
    before = torch.get_num_threads()
    worst, unequal, total = 0.0, 0, 0
    try:
        torch.set_num_threads(1)
        whole = everything(scene, valid)
        for threads, size, frames in (
            (2, count, count),
            (1, 1, sizes.BATCHED_FRAMES),
            (2, 7, min(7 * sizes.BATCHED_FRAMES, count)),
        ):
            torch.set_num_threads(threads)
            for start in range(0, frames, size):
                part = slice(start, start + size)
                own = Scene(scene.cameras.index(part), scene.points[part], scene.key_points[part])
                for a, b in zip(everything(own, valid[part]), whole, strict=True):
                    total += 1
                    if a.dtype.is_floating_point:
                        worst = max(worst, float((a - b[part]).abs().max() / 6000))
                    else:
                        unequal += not torch.equal(a, b[part])
    finally:
        torch.set_num_threads(before)
    differences = f"largest difference {worst:.1e} of the scene, {unequal} masks differ"
    figure = f"geometry, {views} views: {differences}"
    record_row("C4", figure, total - unequal if worst <= 1e-12 else 0, total)
    assert unequal == 0
    assert worst <= 1e-12


def test_c5_types_and_layouts_give_the_same(record_row):
    scene = random_scene(0, 4, 5)
    weights = ones(scene)
    exact = triangulate(scene.cameras, scene.key_points, weights)

    def strided(x):
        return torch.stack((x, x), dim=-1)[..., 0]

    def transposed(x):
        return x.transpose(0, 1).contiguous().transpose(0, 1)

    for layout in (strided, transposed):
        cameras = Cameras(*(layout(x) for x in (scene.cameras.K, scene.cameras.R, scene.cameras.t)))
        other = triangulate(cameras, layout(scene.key_points), layout(weights))
        torch.testing.assert_close(other.points, exact.points, rtol=0, atol=1e-9)
    single = triangulate(scene.cameras, scene.key_points.float(), weights.float())
    worst = float((single.points - exact.points).abs().max())
    assert worst < 0.1  # mm: float32 pixels are 6e-5 pixels off
    assert single.points.dtype == torch.float64
    rounded = triangulate(
        scene.cameras.to(torch.float32), scene.key_points.float(), weights.float()
    )
    worst = max(worst, float((rounded.points - exact.points).abs().max()))
    assert worst < 0.1
    halves = triangulate(scene.cameras, scene.key_points, weights.half())
    assert torch.equal(halves.points, exact.points)
    with_gradient = triangulate(scene.cameras, scene.key_points.clone().requires_grad_(), weights)
    assert torch.equal(with_gradient.points, exact.points)
    record_row("C5", f"geometry: float32 against float64 {worst:.1e} mm, layouts equal", 7, 7)


@pytest.mark.parametrize(
    ("frames", "joints", "hypotheses"), [(0, 17, 5), (2, 0, 5), (2, 17, 0), (0, 0, 0)]
)
@pytest.mark.parametrize("views", [1, 4, 31])
def test_c5_nothing_in_gives_nothing_out(frames, joints, hypotheses, views):
    scene = random_scene(0, 2, views)
    scene = cut(
        Scene(
            scene.cameras.index(slice(0, frames)), scene.points[:frames], scene.key_points[:frames]
        ),
        joints,
    )
    valid = torch.ones(scene.key_points.shape[:-1], dtype=torch.bool)
    assert triangulate(scene.cameras, scene.key_points, valid.double()).points.shape == (
        frames,
        joints,
        3,
    )
    subsets = torch.ones(frames, hypotheses, joints, views, dtype=torch.bool)
    points, ok = triangulate_subsets(scene.cameras, scene.key_points, valid, subsets)
    assert points.shape == (frames, hypotheses, joints, 3)
    assert ok.shape == (frames, hypotheses, joints)
