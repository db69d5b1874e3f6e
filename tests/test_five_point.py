"""Essential matrices of five correspondences, and relative poses refined on all of them."""

from dataclasses import replace

import pytest
import torch

from ghpt.geometry.epipolar import essential, homogeneous, sampson_error, sampson_jacobian
from ghpt.geometry.five_point import five_point
from ghpt.geometry.rotations import vector_to_matrix
from ghpt.metrics.relative_pose import rotation_deg, translation_deg
from ghpt.models.relative_pose.baselines import EightPoint
from ghpt.models.relative_pose.refinement import PoseRefinement
from test_pair_baselines import labelled

REFINEMENT = PoseRefinement(kernel=4.0, trim=4.0, rounds=12)


def random_essentials(count, seed=0):
    """Five points before two cameras, many times: their images and essential matrices."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    points = normal(count, 5, 3) + torch.tensor([0, 0, 6.0])
    R = vector_to_matrix(0.5 * normal(count, 3))
    t = normal(count, 3)
    others = points @ R.mT + t[:, None]
    E = essential(R, t)
    E = E / torch.linalg.matrix_norm(E)[:, None, None]
    return points[..., :2] / points[..., 2:], others[..., :2] / others[..., 2:], E


def test_the_true_matrix_is_among_the_solutions():
    a, b, E = random_essentials(500)
    solutions, exists = five_point(a, b)
    same = (solutions - E[:, None]).abs().amax((-2, -1))
    opposite = (solutions + E[:, None]).abs().amax((-2, -1))
    error = torch.where(exists, torch.minimum(same, opposite), torch.inf).amin(1)
    assert error.quantile(0.98) < 1e-8
    assert (error < 1e-3).all()


def test_every_solution_fulfils_the_equations_and_the_others_are_0():
    a, b, _ = random_essentials(200, seed=1)
    solutions, exists = five_point(a, b)
    residual = torch.einsum("sni,srij,snj->srn", homogeneous(b), solutions, homogeneous(a))
    values = torch.linalg.svdvals(solutions[exists])
    assert residual[exists].abs().max() < 1e-9
    assert (values[:, 0] - values[:, 1]).abs().quantile(0.98) < 1e-6
    assert values[:, 2].quantile(0.98) < 1e-6
    assert (solutions[~exists] == 0).all()
    assert (exists.sum(1) >= 1).all()


@pytest.mark.parametrize("points", [torch.zeros(5, 2), torch.linspace(0, 1, 10).reshape(5, 2)])
def test_samples_that_determine_nothing_are_finite(points):
    a = points.double()[None]
    solutions, _ = five_point(a, a)
    assert torch.isfinite(solutions).all()


def test_leading_dimensions_are_kept():
    a, b, _ = random_essentials(6)
    flat, exists = five_point(a, b)
    folded, folded_exists = five_point(a.reshape(2, 3, 5, 2), b.reshape(2, 3, 5, 2))
    assert torch.equal(folded, flat.reshape(2, 3, 10, 3, 3))
    assert torch.equal(folded_exists, exists.reshape(2, 3, 10))


def test_the_derivatives_of_sampson_distances_are_those_of_the_distances():
    a, b, E = random_essentials(3, seed=2)
    E = E + 0.1
    found, jacobian = sampson_jacobian(E, homogeneous(a), homogeneous(b))
    for entry in range(9):
        change = torch.zeros(9, dtype=torch.float64)
        change[entry] = 1e-6
        more, _ = sampson_jacobian(E + change.view(3, 3), homogeneous(a), homogeneous(b))
        less, _ = sampson_jacobian(E - change.view(3, 3), homogeneous(a), homogeneous(b))
        torch.testing.assert_close((more - less) / 2e-6, jacobian[..., entry], rtol=1e-5, atol=1e-7)
    unsigned = sampson_error(E[:, None], a, b)[:, 0]
    torch.testing.assert_close(found.abs(), unsigned)


def test_refinement_finds_the_pose_of_exact_points_again():
    pairs = labelled()
    R, t = pairs.truth.relative_pose()
    start = EightPoint()(pairs.observations)
    off = vector_to_matrix(torch.full((len(R), 3), 0.01, dtype=torch.float64))
    found = REFINEMENT(replace(start, R=off @ R, t=t), pairs.observations)
    assert rotation_deg(found.R, R).max() < 1e-4
    assert translation_deg(found.t, t).max() < 1e-4
    torch.testing.assert_close(found.t.norm(dim=-1), t.norm(dim=-1))


def test_refinement_is_better_than_the_start_under_noise_and_keeps_what_is_not_estimated():
    pairs = labelled(seeds=range(40), sigma=2.0)
    R, _ = pairs.truth.relative_pose()
    start = EightPoint()(pairs.observations)
    found = REFINEMENT(start, pairs.observations)
    error = rotation_deg(found.R, R)
    assert error.median() < 0.8 * rotation_deg(start.R, R).median()
    missing = replace(start, estimated=torch.zeros_like(start.estimated))
    kept = REFINEMENT(missing, pairs.observations)
    assert torch.equal(kept.R, start.R)
    assert not kept.estimated.any()
