import pytest
import torch
from scipy.spatial.transform import Rotation

from ghpt.models.pose.features import (
    bone_lengths,
    centre_on_pelvis,
    normalised_coordinates,
    torso_normal_to_z,
)
from ghpt.skeleton import BONES, JOINT, PELVIS

ALL = torch.ones(5, 17, dtype=torch.bool)


def poses(seed=0):
    return 300 * torch.randn(
        5, 17, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)
    )


def normal(points):
    left, right, pelvis = (
        points[..., JOINT[n], :] for n in ("left_shoulder", "right_shoulder", "pelvis")
    )
    return torch.nn.functional.normalize(torch.linalg.cross(right - left, pelvis - left), dim=-1)


def test_normal_meets_z_and_nothing_is_deformed():
    x = poses()
    y = normalised_coordinates(x, ALL).reshape(5, 17, 3)
    torch.testing.assert_close(normal(y), torch.tensor([0.0, 0.0, 1.0]).double().expand(5, 3))
    torch.testing.assert_close(torch.cdist(y, y), torch.cdist(x, x))
    assert torch.equal(y[:, PELVIS], torch.zeros(5, 3).double())


def test_invariant_to_translation_and_equivariant_lengths():
    x = poses()
    shift = torch.tensor([1e4, -5e3, 77.0]).double()
    torch.testing.assert_close(
        normalised_coordinates(x + shift, ALL), normalised_coordinates(x, ALL)
    )
    turn = torch.from_numpy(Rotation.random(None, 3).as_matrix())
    torch.testing.assert_close(bone_lengths(x @ turn.T + shift, ALL), bone_lengths(x, ALL))


def test_a_turn_about_z_of_an_upright_normal_only_turns_the_coordinates():
    """The normalisation removes the direction of the normal and nothing else."""
    x = normalised_coordinates(poses(), ALL).reshape(5, 17, 3)
    turn = torch.from_numpy(Rotation.from_euler("z", 40, degrees=True).as_matrix())
    torch.testing.assert_close(normalised_coordinates(x @ turn.T, ALL), (x @ turn.T).flatten(1))


def test_opposite_and_collinear_cases_give_a_rotation():
    flipped = normalised_coordinates(poses(), ALL).reshape(5, 17, 3) * torch.tensor(
        [1.0, -1.0, -1.0]
    )
    turn = torso_normal_to_z(flipped, ALL)
    eye = torch.eye(3, dtype=torch.float64).expand(5, 3, 3)
    torch.testing.assert_close(turn @ turn.mT, eye)
    torch.testing.assert_close(torch.linalg.det(turn), torch.ones(5).double())
    torch.testing.assert_close(normal(flipped @ turn.mT)[:, 2], torch.ones(5).double())
    line = torch.zeros(5, 17, 3, dtype=torch.float64)
    line[..., 0] = torch.arange(17)
    assert torch.equal(torso_normal_to_z(line, ALL), eye)
    assert torch.equal(torso_normal_to_z(0 * line, ALL), eye)


@pytest.mark.parametrize("missing", ["pelvis", "left_shoulder", "nose"])
def test_a_missing_joint_is_zero_and_its_value_does_not_matter(missing):
    x, valid = poses(), ALL.clone()
    valid[:, JOINT[missing]] = False
    other = x.clone()
    other[:, JOINT[missing]] = 1e9
    for featurize in (normalised_coordinates, bone_lengths):
        torch.testing.assert_close(featurize(x, valid), featurize(other, valid))
        assert torch.isfinite(featurize(x, valid)).all()
    assert torch.equal(
        normalised_coordinates(x, valid).reshape(5, 17, 3)[:, JOINT[missing]],
        torch.zeros(5, 3).double(),
    )
    touching = [i for i, bone in enumerate(BONES) if JOINT[missing] in bone]
    assert torch.equal(bone_lengths(x, valid)[:, touching], torch.zeros(5, len(touching)).double())


def test_without_a_pelvis_the_mean_of_the_others_is_the_origin():
    x, valid = poses(), ALL.clone()
    valid[:, PELVIS] = False
    centred = centre_on_pelvis(x, valid)
    torch.testing.assert_close(centred.sum(1), torch.zeros(5, 3).double(), atol=1e-9, rtol=0)
