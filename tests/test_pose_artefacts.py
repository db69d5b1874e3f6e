"""The pose items on metrics that hold the paper's own numbers: no difference, no miss, every claim
of its text true.
"""

from copy import deepcopy
from pathlib import Path

import pytest

from ghpt.metrics.pose_prior import PARTS
from ghpt.models.aggregation import AGGREGATIONS
from ghpt.paper.engine.artefact import Comparison, Results, Spread
from ghpt.paper.pose import base_dataset, generalization, other_systems
from ghpt.paper.pose import figures as pose_figures
from ghpt.paper.published import (
    GENERALIZATION,
    LIMITATION,
    QUANTITATIVE,
    QUANTITATIVE_HYPOTHESES,
    SOTA,
)
from sections import markdown, setup

SETUP = setup()
REAL = setup(roots={"human36m": "/data/human36m", "panoptic": "/data/panoptic"})
ARTEFACTS = {
    i.label: i
    for part in (generalization, other_systems, base_dataset, pose_figures)
    for i in part.ARTEFACTS
}
ESTIMATORS = (*AGGREGATIONS, "frame_learned", *base_dataset.BASELINES)
PRIOR = {"weight": 1e-3, "best": 1.1e-3, "average": 2e-3}


def papers(name):
    """metrics.json of the test task ``"cmu1 on h36m"`` as the paper has it."""
    if name in LIMITATION:
        errors = dict.fromkeys(ESTIMATORS, LIMITATION[name])
    else:
        train, test = name.split(" on ")
        errors = dict.fromkeys(ESTIMATORS, 40.0)
        errors |= QUANTITATIVE_HYPOTHESES["h36m" if test == "h36m" else "panoptic"]
        errors |= {"weight": GENERALIZATION[train, test]}
        if (
            name == "cmu3 on cmu3"
        ):  # tab:quantitative-hypotheses has another arrangement's number, so nearly this one
            errors["weight"] = QUANTITATIVE_HYPOTHESES["panoptic"]["weight"]
    return {
        "data": "h36m",
        "source": "synthetic",
        "split": "test",
        "provenance": {},
        "frames": 100,
        "selections": {
            name: {
                "mpjpe_relative": error,
                "mpjpe_6_joints": error,
                "per_action": QUANTITATIVE,
                "pose_prior": {
                    "S9": {p: PRIOR.get(name, 4e-3 if name == "most" else 9e-3) for p in PARTS}
                },
            }
            for name, error in errors.items()
        },
    }


class Fake(Results):
    """Results that read from a function instead of from folders; ``change(name, metrics)`` for each
    seed.
    """

    def __init__(self, *changes, setup=SETUP):
        super().__init__([setup] * len(changes), [{}] * len(changes), Path())
        self.changes = changes

    def read(self, name, file="result.json"):
        found = []
        for change in self.changes:
            metrics = deepcopy(papers(name))
            change(name, metrics)
            found.append(metrics)
        return found


def same(name, metrics):
    """The paper's numbers."""


TABLES = (
    "generalization-evaluation",
    "iskakov-comparison",
    "remelli-comparison",
    "sota-comparison",
    "quantitative",
    "quantitative-hypotheses",
    "limitation-table",
)


@pytest.mark.parametrize("label", TABLES)
def test_the_papers_own_numbers_have_no_miss_and_all_of_its_claims(label):
    section = ARTEFACTS[label].section(Fake(same, setup=REAL))
    assert all(claim.holds for claim in section.claims), [c for c in section.claims if not c.holds]
    assert section.claims
    rounding = {
        "generalization-evaluation": 0.005,
        "remelli-comparison": 0.005,
        "sota-comparison": 0.005,
    }
    for number in section.comparisons:
        assert abs(number.difference) <= rounding.get(label, 1e-9), number
    assert "miss" not in markdown(section)
    assert "synthetic" not in section.data
    synthetic = ARTEFACTS[label].section(Fake(same))
    assert "synthetic" in synthetic.data
    published = label in ("iskakov-comparison", "sota-comparison", "quantitative")
    assert (None in [claim.holds for claim in synthetic.claims]) == published


def worse(name, metrics):
    for selection in ("weight", "most"):
        metrics["selections"][selection]["mpjpe_relative"] *= 1.5 if name != "h36m on h36m" else 3


@pytest.mark.parametrize(
    "label", [label for label in TABLES if label not in ("quantitative", "limitation-table")]
)
def test_a_worse_model_misses_and_its_claims_fall(label):
    section = ARTEFACTS[label].section(Fake(worse, setup=REAL))
    assert any(number.miss for number in section.comparisons)
    assert not all(claim.holds for claim in section.claims)
    assert ("(miss)" in markdown(section)) is (label != "remelli-comparison")  # claims alone


def test_numbers_over_seeds_have_their_deviation():
    def shifted(name, metrics):
        metrics["selections"]["weight"]["mpjpe_relative"] += 1

    section = ARTEFACTS["iskakov-comparison"].section(Fake(same, shifted))
    assert "31.5 ± 0.7" in markdown(section)
    assert Spread((31.0, 32.0)).deviation == pytest.approx(0.5**0.5)
    assert Spread((31.0,)).text() == "31.0"


@pytest.mark.parametrize(
    ("paper", "ours", "better", "miss"),
    [
        (10.0, 10.4, "lower", False),
        (10.0, 10.6, "lower", True),
        (10.0, 5.0, "lower", False),
        (10.0, 5.0, "same", True),
        (10.0, 10.4, "same", False),
        (None, 3.0, "lower", False),
    ],
)
def test_what_is_a_miss(paper, ours, better, miss):
    number = Comparison("x", paper, Spread((ours,)), better)
    assert number.miss == miss
    assert ("(miss)" in number.cells()[2]) == miss


def test_a_drop_to_novel_arrangements_is_of_the_trained_one():
    def drop(name, metrics):
        train, test = name.split(" on ")
        metrics["selections"]["weight"]["mpjpe_relative"] = 20.0 if train == test else 22.0

    rows = [
        row
        for row in markdown(ARTEFACTS["remelli-comparison"].section(Fake(drop))).splitlines()
        if "ours (CMU" in row
    ]
    assert len(rows) == 4
    assert all(row.split("|")[-2].strip() == "+10.0 %" for row in rows)


def test_baselines_on_panoptic_are_the_mean_of_the_four_arrangements():
    def ransac(name, metrics):
        metrics["selections"]["ransac"]["mpjpe_relative"] = 10.0 * int(name[3])

    body = markdown(ARTEFACTS["sota-comparison"].section(Fake(ransac)))
    row = next(line for line in body.splitlines() if line.startswith("| RANSAC on our"))
    assert row.split("|")[3].strip() == "25.0"
    assert f"{SOTA['RANSAC']}" in body


def test_the_pose_prior_claims_follow_the_numbers():
    def flipped(name, metrics):
        for part in PARTS:
            metrics["selections"]["least"]["pose_prior"]["S9"][part] = 1e-5

    good, bad = (ARTEFACTS["pose-prior"].section(Fake(change)) for change in (same, flipped))
    assert [claim.holds for claim in good.claims] == [True, True, True, True]
    assert [claim.holds for claim in bad.claims] == [False, False, False, True]
    assert list(good.figures) == ["pose-prior"]


def test_other_systems_have_estimators_of_the_same_detections_beside_them():
    def change(name, metrics):
        metrics["selections"]["frame_learned"]["mpjpe_relative"] = 20.0

    body = markdown(ARTEFACTS["sota-comparison"].section(Fake(change)))
    (row,) = (line for line in body.splitlines() if line.startswith("| learned frames"))
    assert row.split("|")[3].strip() == "20.0"
    assert any(line.startswith("| adaptive RANSAC on our detections") for line in body.splitlines())


def test_only_tests_on_the_own_arrangement_have_other_estimators_beside_the_model():
    grid = generalization.grid(SETUP)
    assert {name for name, task in grid.items() if task.config["baselines"]} == {
        f"{data} on {data}" for data in generalization.ARRANGEMENTS
    }
    limitation = ARTEFACTS["limitation-table"].tasks(SETUP)
    assert not limitation["train"].config["baselines"]
    assert limitation["test"].config["baselines"]


def test_hyperparameters_are_those_of_the_configuration():
    body = markdown(ARTEFACTS["hyperparameters"].section(Results([SETUP], [{}], Path())))
    row = next(line for line in body.splitlines() if "alpha" in line)
    assert [task.strip() for task in row.split("|")[2:6]] == [
        "1.0, 0.01, 0.02",
        "1.0, 0.01, 0.02",
        "1.0, 0.01, 0.0",
        "1.0, 0.01, 0.0",
    ]
    changed = setup(train=("model.hypotheses=77",))
    assert "77" in markdown(ARTEFACTS["hyperparameters"].section(Results([changed], [{}], Path())))


def test_tasks_are_shared_between_items():
    grid = generalization.grid(SETUP)
    assert len(grid) == 25
    itself = base_dataset.on_itself(SETUP, "h36m", "cmu3")
    for name, task in itself.items():
        assert grid[name].key == task.key
    limitation = ARTEFACTS["limitation-table"].tasks(SETUP)
    assert limitation["test"].key == grid["h36m on h36m"].key
    assert len({task.dependencies["model"].key for task in grid.values()}) == 5
    other = setup(1)
    assert generalization.grid(other)["cmu1 on h36m"].key != grid["cmu1 on h36m"].key
    data = [s.preparation("h36m", "test").key for s in (SETUP, other)]
    assert data[0] == data[1]  # seeds share the recordings
