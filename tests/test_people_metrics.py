"""Metrics of several people, on cases whose values follow from the definitions."""

import pytest
import torch

from ghpt.metrics.people import PeopleError, Tracking
from ghpt.observations import PoseEstimate, Truth
from ghpt.skeleton import JOINT

BODY = torch.zeros(17, 3)
BODY[:, 2] = torch.linspace(0, 1600, 17)


def people(places: list[list[float | None]]) -> tuple[torch.Tensor, torch.Tensor]:
    """Points [T P 17 3] of bodies at these places (mm) of each frame, None: nobody."""
    at = torch.tensor([[0.0 if x is None else x for x in row] for row in places])
    there = torch.tensor([[x is not None for x in row] for row in places])
    points = BODY + at[..., None, None] * torch.tensor([1.0, 0, 0])
    return points, there[..., None].expand(*there.shape, 17)


def scores(metric, truth, estimate):
    metric.update(PoseEstimate(*people(estimate)), Truth(*people(truth)))
    return metric.compute()


TRUTH = [[0.0, 2000.0]] * 4


def test_a_switch_is_counted_once_and_halves_idf1():
    """Two estimates change places after two of four frames: each true person goes on as another."""
    estimate = [[0.0, 2000.0]] * 2 + [[2000.0, 0.0]] * 2
    found = scores(Tracking(500.0), TRUTH, estimate)
    assert int(found.switches) == 2
    assert float(found.mota) == pytest.approx(1 - 2 / 8)
    assert float(found.idf1) == pytest.approx(0.5)


def test_a_switch_across_a_gap_counts():
    found = scores(Tracking(500.0), [[0.0]] * 3, [[0.0, None], [None, None], [None, 0.0]])
    assert int(found.switches) == 1
    assert float(found.mota) == pytest.approx(1 - 2 / 3)
    assert float(found.idf1) == pytest.approx(2 * 1 / (3 + 2))


def test_a_match_goes_on_while_it_is_within_reach():
    """A nearer newcomer takes nobody's place."""
    found = scores(Tracking(500.0), [[0.0]] * 2, [[100.0, None], [400.0, 0.0]])
    assert int(found.switches) == 0
    assert float(found.mota) == pytest.approx(1 - 1 / 2)


def test_missed_and_invented_people_lessen_recall_and_precision():
    found = scores(PeopleError(150.0), TRUTH, [[50.0, None, 9000.0]] * 4)
    assert float(found.recall) == pytest.approx(1 / 2)
    assert float(found.precision) == pytest.approx(1 / 2)
    assert float(found.mpjpe) == pytest.approx(50.0)


def test_pcp_is_half_of_the_limb_and_a_missing_joint_is_wrong():
    """A shank of 100 mm whose ankle is 90 mm off is correct, for 45 on average, one whose ankle is
    110 mm off is not.
    """
    points, valid = people([[0.0]])
    points[..., JOINT["right_knee"], :] = points[..., JOINT["right_ankle"], :] + torch.tensor(
        [100.0, 0, 0]
    )
    shares = []
    for offset in (90.0, 110.0):
        moved = points.clone()
        moved[..., JOINT["right_ankle"], 1] += offset
        metric = PeopleError(500.0)
        metric.update(PoseEstimate(moved, valid), Truth(points, valid))
        shares.append(float(metric.compute().pcp))
    assert shares == pytest.approx([1.0, 0.9])
    missing = valid.clone()
    missing[..., JOINT["head_top"]] = False
    metric = PeopleError(500.0)
    metric.update(PoseEstimate(points, missing), Truth(points, valid))
    assert float(metric.compute().pcp) == pytest.approx(0.9)
    assert float(metric.compute().pcp_without_head) == pytest.approx(1.0)


def test_nobody_estimated_is_no_error():
    metric = PeopleError(150.0)
    points = torch.zeros(4, 0, 17, 3)
    metric.update(
        PoseEstimate(points, torch.zeros(4, 0, 17, dtype=torch.bool)), Truth(*people(TRUTH))
    )
    assert float(metric.compute().recall) == 0.0
    assert float(metric.compute().pcp) == 0.0
