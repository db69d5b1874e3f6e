"""Joints that are means of key points: what is known of a mean follows from its parts."""

import torch

from ghpt.data.formats.skeletons import find_skeleton, skeleton_of
from ghpt.models.estimators.joint_means import all_joints, human_joints
from ghpt.reconstruction import State
from ghpt.skeleton import HUMAN36M, JOINT, JOINTS
from reconstructions import random_reconstruction

COCO = find_skeleton("x", "coco_17")
EYES_AND_EARS = [
    COCO.key_points.index(f"{s}_{p}") for p in ("eye", "ear") for s in ("left", "right")
]
HEAD = all_joints(COCO).joints.index("head_top")
MADE = random_reconstruction(200, joints=17, missing=0.2)


def test_all_that_the_detector_gives_stays_as_it_is():
    joints = all_joints(COCO)
    found = joints(MADE).select_joints(
        torch.tensor([joints.joints.index(name) for name in COCO.key_points])
    )
    for name in ("points", "state", "error", "covariance", "views"):
        assert torch.equal(getattr(found, name), getattr(MADE, name))


def test_the_17_come_first_and_what_the_detector_lacks_is_a_mean_in_3d():
    joints = all_joints(COCO)
    found = joints(MADE)
    assert joints.joints == (*JOINTS, "left_eye", "right_eye", "left_ear", "right_ear")
    hips = [COCO.key_points.index(f"{side}_hip") for side in ("left", "right")]
    shoulders = [COCO.key_points.index(f"{side}_shoulder") for side in ("left", "right")]
    pelvis = found.points[:, JOINT["pelvis"]]
    torch.testing.assert_close(pelvis, MADE.points[:, hips].mean(1))
    spine = found.points[:, JOINT["spine"]]
    torch.testing.assert_close(spine, MADE.points[:, hips + shoulders].mean(1))


def test_a_mean_has_the_state_of_its_worst_part():
    found = all_joints(COCO)(MADE)
    assert torch.equal(found.state[:, HEAD], MADE.state[:, EYES_AND_EARS].amax(1))
    assert 0 < int(found.has_position[:, HEAD].sum()) < 200


def test_the_error_of_a_mean_is_over_all_views_of_all_parts():
    found = all_joints(COCO)(MADE)
    count = MADE.views[:, :, EYES_AND_EARS].sum(1)
    square = (count * MADE.error[:, EYES_AND_EARS] ** 2).sum(1) / count.sum(1).clamp(min=1)
    torch.testing.assert_close(found.error[:, HEAD], square.sqrt())
    measured = found.is_measured[:, HEAD]
    any_part = MADE.views[:, :, EYES_AND_EARS].any(-1)
    assert torch.equal(found.views[:, :, HEAD], any_part & measured[:, None])


def test_the_covariance_of_a_mean_holds_whatever_its_parts_have_in_common():
    """The same error in all parts is the mean's error: no smaller than its covariance says."""
    alike = MADE.covariance[:, EYES_AND_EARS[:1]].expand(-1, 17, -1)
    made = type(MADE)(**vars(MADE) | {"covariance": alike})
    found = all_joints(COCO)(made)
    torch.testing.assert_close(found.covariance[:, HEAD], alike[:, 0])


def test_the_17_of_a_detector_are_in_their_order():
    joints = human_joints(COCO)
    found = joints(MADE)
    assert joints.joints == JOINTS
    assert torch.equal(found.points[:, JOINT["nose"]], MADE.points[:, 0])
    assert torch.equal(human_joints(HUMAN36M)(MADE).points, MADE.points)


def test_a_joint_that_the_detector_cannot_give_has_no_position():
    mpii = find_skeleton("x", "mpii_16")
    made = random_reconstruction(5, joints=16, missing=0.0)
    found = human_joints(mpii)(made)
    assert (found.state[:, JOINT["nose"]] == State.FEW_VIEWS).all()


def test_key_points_of_an_animal_are_all_there_is():
    mouse = skeleton_of("x", ("snout", "left_ear", "right_ear", "tail_base", "tail_tip"))
    joints = all_joints(mouse)
    assert joints.joints == mouse.key_points
    made = random_reconstruction(5, joints=5)
    assert torch.equal(joints(made).points, made.points)
