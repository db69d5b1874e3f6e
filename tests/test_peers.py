"""Other people's triangulation, as predict.py compares with it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from composed import compose
from ghpt.config import build
from ghpt.errors import GhptConfigError
from ghpt.extras import is_installed
from ghpt.geometry.state import State
from predicting import sequence_of, walk

FRAMES = 6
FAR = 80.0


def peer(name, **changed):
    return build(compose("predict")["peers"][name] | changed, f"compare.{name}")


@pytest.fixture(scope="module")
def batch():
    """Exact key points, but of a joint in the first frame, which is 80 px off in a view."""
    found = sequence_of(FRAMES, noise=0.0, gaps=0.0).read(np.arange(FRAMES))
    key_points = found.key_points.clone()
    key_points[0, 1, 0, 0] += FAR
    confidence = torch.full_like(found.confidence, 0.5)
    confidence[:, 2] = 0.9
    return replace(found, key_points=key_points, confidence=confidence)


def test_a_view_that_disagrees_is_excluded_and_the_others_are_right(batch):
    found = peer("pose2sim").triangulate(batch)
    assert bool(found.ok.all())
    torch.testing.assert_close(found.points, walk()[:FRAMES], atol=0.5, rtol=0)


def test_the_equations_are_weighted_with_the_confidence(batch):
    every = peer("pose2sim", largest_error=FAR).triangulate(batch)
    camera = batch.cameras.index(0)
    rows = []
    for view in range(4):
        P = (
            camera.K[view] @ torch.cat((camera.R[view], camera.t[view, :, None] / 1000), 1)
        ).numpy()
        x, y = batch.key_points[0, view, 0].tolist()
        weight = float(batch.confidence[0, view, 0])
        rows += [weight * (x * P[2] - P[0]), weight * (y * P[2] - P[1])]
    solution = np.linalg.svd(np.stack(rows))[2][-1]
    expected = 1000 * solution[:3] / solution[3]
    np.testing.assert_allclose(every.points[0, 0].numpy(), expected, atol=1e-2)


def test_what_no_subset_explains_is_missing(batch):
    key_points = batch.key_points.clone()
    key_points[0, :, 0] += 300 * torch.randn(4, 2, generator=torch.Generator().manual_seed(0))
    found = peer("pose2sim", largest_error=0.1).triangulate(replace(batch, key_points=key_points))
    assert int(found.status[0, 0]) == State.REJECTED
    kept = peer("pose2sim", most_subsets=1).triangulate(batch)
    assert int(kept.status[0, 0]) == State.REJECTED
    assert bool(kept.ok[1:].all())


def test_views_without_confidence_do_not_count(batch):
    found = peer("pose2sim", least_confidence=0.6).triangulate(batch)
    assert not bool(found.has_position.any())


def test_aniposelib_is_a_row_where_it_is_installed(batch):
    if not is_installed("aniposelib"):
        with pytest.raises(GhptConfigError, match=r"ghpt\[anipose\]"):
            peer("aniposelib")
        return
    found = peer("aniposelib_robust").triangulate(batch)
    torch.testing.assert_close(found.points[1:], walk()[1:FRAMES], atol=0.5, rtol=0)
