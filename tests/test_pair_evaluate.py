import json

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ghpt.files import write_json
from ghpt.models.relative_pose.evaluation import (
    ALONE,
    ERRORS,
    NAMES,
    errors_of_pair,
    evaluate_pairs,
)
from ghpt.observations import RelativePoseEstimate
from pair_report import content, moved, rig, written

RIGS = [rig(9), rig(11)]
PAIRS = ["1-2", "1-3", "1-4", "2-3", "2-4", "3-4"]


def slow_errors(own, pair, R, t) -> dict[str, float]:
    """Section 4.5 for one pair, by numpy and scipy: homogeneous projections, triangulation by an
    SVD for each point.
    """
    a, b = pair
    K, Rw, tw = (getattr(own.cameras, name).numpy() for name in ("K", "R", "t"))
    true_R, true_t = Rw[b] @ Rw[a].T, tw[b] - Rw[b] @ Rw[a].T @ tw[a]
    quaternions = [Rotation.from_matrix(m).as_quat(canonical=True) for m in (R, true_R)]
    P_a, P_b = (K[v] @ np.column_stack((Rw[v], tw[v])) for v in (a, b))
    # World -> reference -> target as two 4x4 steps.
    to_a = np.vstack((np.column_stack((Rw[a], tw[a])), [0, 0, 0, 1]))
    estimated_b = K[b] @ np.column_stack((R, t)) @ to_a
    pixel, space = [], []
    for X in np.column_stack((own.points.numpy(), np.ones(len(own.points)))):
        xa, xb, xe = (P @ X for P in (P_a, P_b, estimated_b))
        xa, xb, xe = xa[:2] / xa[2], xb[:2] / xb[2], xe[:2] / xe[2]
        pixel.append(np.linalg.norm(xe - xb))
        rows = []
        for x, P, k in ((xa, P_a, K[a]), (xb, estimated_b, K[b])):
            unit = np.linalg.inv(k) @ P
            u, v, w = np.linalg.inv(k) @ [*x, 1]
            rows += [u / w * unit[2] - unit[0], v / w * unit[2] - unit[1]]
        normal = np.linalg.lstsq(np.array(rows)[:, :3], -np.array(rows)[:, 3], rcond=None)[0]
        space.append(np.linalg.norm(normal - X[:3]))
    cosine = t @ true_t / np.linalg.norm(t) / np.linalg.norm(true_t)
    return {
        "E_R": np.linalg.norm(quaternions[0] - quaternions[1]),
        "E_t": np.linalg.norm(t - true_t),
        "E_2D": np.mean(pixel),
        "E_3D": np.mean(space),
        "rotation_deg": np.rad2deg(
            (Rotation.from_matrix(R) * Rotation.from_matrix(true_R).inv()).magnitude()
        ),
        "translation_deg": np.rad2deg(np.arccos(np.clip(cosine, -1, 1))),
    }


def test_numbers_equal_a_slow_reference(tmp_path):
    values = content(RIGS, draws=3)
    metrics = evaluate_pairs(written(tmp_path, RIGS, values)).plain()
    for name in ("weight", "worst"):
        estimate = values["estimates"][name]
        for number, (pair, numbers) in enumerate(metrics["selections"][name]["pairs"].items()):
            rows = range(number, len(values["draw"]), 6)
            owns, views = [RIGS[g] for g in values["rig"].tolist()], values["pair"].tolist()
            each = [
                slow_errors(owns[i], views[i], estimate.R[i].numpy(), estimate.t[i].numpy())
                for i in rows
            ]
            for error in ERRORS:
                expected = [e[error] for e in each]
                # The reference solves the triangulation's equations with other weights for the two
                # rays.
                tolerance = 0.05 if error == "E_3D" else 1e-6
                assert numbers[error] == pytest.approx(np.median(expected), rel=tolerance), (
                    name,
                    pair,
                    error,
                )
                assert numbers["mean"][error] == pytest.approx(np.mean(expected), rel=tolerance)
                assert numbers["deviation"][error] == pytest.approx(
                    np.std(expected, ddof=1), rel=4 * tolerance
                )


def test_the_truth_has_no_error(tmp_path):
    values = content(RIGS, draws=1)
    exact = moved(values["truth"], 0.0, 0.0, seed=0)
    values["estimates"] = {"weight": exact}
    weight = evaluate_pairs(written(tmp_path, RIGS, values)).plain()["selections"]["weight"]
    assert max(weight[error] for error in ERRORS) < 1e-5
    assert weight["coverage"] == 1


def test_form_is_the_documented_one(tmp_path):
    metrics = evaluate_pairs(written(tmp_path, RIGS, content(RIGS, draws=3))).plain()
    assert list(metrics) == [
        "format_version",
        "data",
        "source",
        "split",
        "problem",
        "frames",
        "draws",
        "cameras",
        "seed",
        "provenance",
        "selections",
    ]
    assert (metrics["problem"], metrics["frames"], metrics["draws"]) == ("camera", 80, 6)
    assert metrics["cameras"] == ["c0", "c1", "c2", "c3"]
    assert list(metrics["selections"]) == [
        "weight",
        "average",
        "worst",
        "eight_point",
        "poselib",
        "rig",
    ]
    for numbers in metrics["selections"].values():
        assert list(numbers) == [*ERRORS, "coverage", "pairs"]
        assert list(numbers["pairs"]) == PAIRS
        for pair in numbers["pairs"].values():
            assert list(pair) == [*ERRORS, "coverage", "mean", "deviation", *ALONE]
            assert list(pair["mean"]) == list(pair["deviation"]) == list(ERRORS)
        for error in ERRORS:
            assert numbers[error] == pytest.approx(
                np.mean([pair[error] for pair in numbers["pairs"].values()])
            )
    assert NAMES[-1] == "rig"
    write_json(tmp_path / "metrics.json", metrics)
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics


def without(values: dict, name: str, drop: torch.Tensor) -> None:
    e = values["estimates"][name]
    R = torch.where(drop[:, None, None], torch.eye(3, dtype=torch.float64), e.R)
    values["estimates"][name] = RelativePoseEstimate(
        R, torch.where(drop[:, None], 0.0, e.t), e.estimated & ~drop
    )


def test_nobody_wins_by_dropping_the_hard_draws(tmp_path):
    values = content(RIGS, draws=5)
    values["estimates"]["average"] = values["estimates"]["weight"]
    before = evaluate_pairs(written(tmp_path, RIGS, values)).selections["weight"].pairs["1-2"]
    rows = torch.arange(0, 60, 6)  # the ten draws of pair 1-2
    errors = torch.linalg.vector_norm(
        values["estimates"]["weight"].t[rows] - values["truth"][1][rows], dim=-1
    )
    hard = rows[errors.argsort(descending=True)[:3]]
    without(values, "average", torch.isin(torch.arange(60), hard))
    after = evaluate_pairs(written(tmp_path, RIGS, values)).selections["average"].pairs["1-2"]
    assert after.coverage == 0.7
    assert after.median["E_t"] == before.median["E_t"]  # the hard ones were above it already
    assert after.mean["E_t"] < before.mean["E_t"]  # the mean of what is left needs the coverage


def test_a_median_that_is_infinite_is_null_in_the_file(tmp_path):
    values = content(RIGS, draws=5)
    first = (values["pair"] == torch.tensor([0, 1])).all(-1)
    without(values, "weight", first & (values["draw"] % 5 < 4))
    without(values, "average", torch.ones(60, dtype=torch.bool))
    metrics = evaluate_pairs(written(tmp_path, RIGS, values)).plain()
    write_json(tmp_path / "metrics.json", metrics)
    read = json.loads((tmp_path / "metrics.json").read_text())["selections"]
    assert read["weight"]["pairs"]["1-2"]["E_3D"] is None
    assert read["weight"]["pairs"]["1-2"]["coverage"] == pytest.approx(0.2)
    assert read["weight"]["pairs"]["1-2"]["mean"]["E_3D"] > 0
    assert read["weight"]["pairs"]["1-3"]["E_3D"] > 0
    assert read["weight"]["E_3D"] is None
    nothing = read["average"]["pairs"]["3-4"]
    assert nothing["coverage"] == 0
    assert all(nothing[key][error] is None for key in ("mean", "deviation") for error in ERRORS)


def test_one_part_alone_is_as_if_the_other_were_true(tmp_path):
    values = content(RIGS, draws=3)
    truth, estimate = values["truth"], values["estimates"]["weight"]
    every = torch.ones(len(values["draw"]), dtype=torch.bool)
    values["estimates"] |= {
        "average": RelativePoseEstimate(estimate.R, truth[1], every),
        "worst": RelativePoseEstimate(truth[0], estimate.t, every),
    }
    selections = evaluate_pairs(written(tmp_path, RIGS, values)).plain()["selections"]
    for pair in PAIRS:
        for part, same in (("estimated_R", "average"), ("estimated_t", "worst")):
            for error in ("E_2D", "E_3D"):
                alone = selections["weight"]["pairs"][pair][part][error]
                assert alone == pytest.approx(selections[same]["pairs"][pair][error], rel=1e-9)
        assert selections["worst"]["pairs"][pair]["estimated_R"]["E_3D"] < 1e-5


def test_chunks_do_not_matter(tmp_path, monkeypatch):
    opened = written(tmp_path, RIGS, content(RIGS, draws=3))
    whole = evaluate_pairs(opened).plain()
    monkeypatch.setattr("ghpt.models.relative_pose.evaluation._CHUNK", 7)
    again = evaluate_pairs(opened).plain()
    for name, numbers in again["selections"].items():
        for error in ERRORS:
            assert numbers[error] == pytest.approx(whole["selections"][name][error], rel=1e-9)


def test_errors_of_a_pair_are_those_of_its_draws(tmp_path):
    opened = written(tmp_path, RIGS, content(RIGS, draws=4))
    errors, metrics = errors_of_pair(opened, (1, 2), "E_3D"), evaluate_pairs(opened).plain()
    for name, values in errors.items():
        assert len(values) == 8
        assert np.median(values) == metrics["selections"][name]["pairs"]["2-3"]["E_3D"]
