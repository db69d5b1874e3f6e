from dataclasses import replace

import pytest
import torch

from ghpt.errors import GhptConfigError
from ghpt.geometry.cameras import Cameras
from ghpt.models.estimators.flips import LeftRightFlips, undo_flips
from ghpt.models.estimators.ransac import AdaptiveRansac
from ghpt.skeleton import JOINT, JOINTS, MIRROR, make_skeleton
from scenes import random_scene

ROBUST = AdaptiveRansac(threshold=0.02, pairs=24, seed=0, adapt=5.0, quantile=0.55, rounds=4)
SWAPS = LeftRightFlips(ROBUST, scale=0.04, gain=6.0, rounds=3, views=4)


def good(views=4, frames=300):
    scene = random_scene(views, frames, views)
    return scene.noisy(4, 0).batch(), scene.points


def flipped(batch, share=0.05):
    """At most one view of a frame with its sides exchanged, ``share`` of all views."""
    frames, views, _ = batch.valid.shape
    generator = torch.Generator().manual_seed(0)
    hit = torch.rand(frames, 1, generator=generator) < share * views
    hit = hit & (torch.randint(views, (frames, 1), generator=generator) == torch.arange(views))
    points = torch.where(
        hit[..., None, None], batch.key_points[:, :, list(MIRROR)], batch.key_points
    )
    return replace(batch, key_points=points), hit


@pytest.mark.parametrize(("views", "share"), [(3, 0.98), (4, 0.98), (7, 0.98)])
def test_nearly_all_swaps_are_found_and_nearly_none_invented(views, share):
    batch, truth = good(views)
    bad, hit = flipped(batch)
    mended, found = undo_flips(bad, SWAPS)
    assert (found & hit).sum() >= share * hit.sum()
    assert (found & ~hit).sum() <= 0.005 * (~hit).sum()
    right = (found == hit).all(1)
    same = (mended.key_points == batch.key_points).all(-1).all(-1).all(-1)
    assert (
        same[right & hit.any(1)].double().mean() > 0.9
    )  # the rest: one pair of limbs that overlap is left
    error = [(ROBUST(b).points - truth).norm(dim=-1).mean() for b in (batch, mended, bad)]
    assert error[1] < error[0] + 2 * (1 - share) * (error[2] - error[0])


def test_good_views_stay_as_they_are():
    batch, truth = good()
    mended, found = undo_flips(batch, SWAPS)
    assert found.double().mean() <= 0.001
    assert (ROBUST(mended).points - truth).norm(dim=-1).mean() <= (
        ROBUST(batch).points - truth
    ).norm(dim=-1).mean()


def test_two_views_cannot_tell():
    bad, _ = flipped(good(2, 50)[0], share=0.3)
    mended, found = undo_flips(bad, SWAPS)
    assert not found.any()
    assert torch.equal(mended.key_points, bad.key_points)


def test_what_is_not_seen_moves_with_its_key_point():
    bad, hit = flipped(good()[0])
    valid = bad.valid.clone()
    frame, view = (int(x[0]) for x in torch.nonzero(hit, as_tuple=True))
    valid[frame, view, 0] = False
    confidence = bad.confidence.clone()
    confidence[frame, view, 1] = 0.25
    mended, found = undo_flips(replace(bad, valid=valid, confidence=confidence), SWAPS)
    assert found[frame, view]
    assert not mended.valid[frame, view, MIRROR[0]]
    assert mended.valid[frame, view, 0]
    assert mended.confidence[frame, view, MIRROR[1]] == 0.25


def test_the_order_of_the_views_is_nothing():
    bad, _ = flipped(good(5, 60)[0])
    order = torch.tensor([3, 1, 4, 0, 2])
    cameras = Cameras(*(x[:, order] for x in (bad.cameras.K, bad.cameras.R, bad.cameras.t)))
    fields = {name: getattr(bad, name)[:, order] for name in ("key_points", "confidence", "valid")}
    assert torch.equal(
        undo_flips(replace(bad, cameras=cameras, **fields), SWAPS)[1],
        undo_flips(bad, SWAPS)[1][:, order],
    )


def test_impossible_settings_are_refused():
    with pytest.raises(GhptConfigError):
        LeftRightFlips(ROBUST, scale=0.0, gain=6.0, rounds=3, views=4)


def test_feet_and_hands_are_exchanged_with_their_limbs_and_the_face_is_not():
    """The 17 in another order, with toes, finger tips and eyes."""
    names = (*reversed(JOINTS), *EXTRA)
    skeleton = make_skeleton("x", "extended", names)
    batch, _ = good(4, 100)
    near = {"big_toe": "ankle", "middle_finger4": "wrist", "eye": "shoulder"}
    order = [JOINT[name] for name in reversed(JOINTS)]
    order += [JOINT[f"{side}_{near[part]}"] for side, part in map(split_side, EXTRA)]
    other = replace(
        batch,
        key_points=batch.key_points[:, :, order],
        confidence=batch.confidence[:, :, order],
        valid=batch.valid[:, :, order],
    )
    _, hit = flipped(batch)
    points = other.key_points[:, :, list(skeleton.mirror)]
    eyes = [names.index(name) for name in EXTRA if "eye" in name]
    points[:, :, eyes] = other.key_points[:, :, eyes]
    bad = replace(other, key_points=torch.where(hit[..., None, None], points, other.key_points))
    mended, found = undo_flips(bad, SWAPS.for_skeleton(skeleton))
    right = (found == hit).all(1)
    assert right.double().mean() > 0.95
    same = (mended.key_points == other.key_points).flatten(1).all(1)
    assert same[right & hit.any(1)].double().mean() > 0.9


EXTRA = tuple(
    f"{side}_{part}" for part in ("big_toe", "middle_finger4", "eye") for side in ("left", "right")
)


def split_side(name):
    return name.split("_", 1)


def test_a_skeleton_without_limbs_has_no_flips():
    batch, _ = good(4, 5)
    mouse = make_skeleton("x", "mouse", [f"point_{joint}" for joint in range(17)])
    _, found = undo_flips(flipped(batch)[0], SWAPS.for_skeleton(mouse))
    assert not found.any()
