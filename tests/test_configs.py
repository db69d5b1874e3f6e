"""Every choice of the configuration composes and builds, and its numbers are the paper's."""

from pathlib import Path

import lightning as L
import pytest

from composed import compose
from ghpt.config import build, check_arguments

CONF = Path(__file__).resolve().parents[1] / "conf"


def choices(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("[!_]*.yaml"))


def test_the_groups_hold_the_issue_s_choices():
    assert {"cmu1", "cmu2", "cmu3", "cmu4", "h36m"} <= set(choices("data"))
    assert choices("model") == ["camera", "joint", "key_points", "pose"]
    assert choices("experiment") == [
        "coordinates_only",
        "lengths_only",
        "no_gumbel",
        "selection_stochastic",
    ]


@pytest.mark.parametrize("experiment", [None, *choices("experiment")])
@pytest.mark.parametrize("data", choices("data"))
def test_every_choice_composes_and_builds(data, experiment):
    small = ["model.scorer.layers=[2]"]  # only the widths, for the time
    config = compose(
        "train",
        f"data={data}",
        "model=pose",
        *small,
        *([f"experiment={experiment}"] * bool(experiment)),
    )
    assert build(config["data"], "data").name == data
    built = build(config["model"], "model")
    assert built.problem.feature_size == {"coordinates_only": 51, "lengths_only": 16}.get(
        experiment, 67
    )
    assert (built.gumbel, built.selection) == {
        "no_gumbel": (False, "weight"),
        "selection_stochastic": (True, "stochastic"),
    }.get(experiment, (True, "weight"))
    check_arguments(L.Trainer, config["trainer"], "trainer")


@pytest.mark.parametrize("data", [data for data in choices("data") if data != "people"])
def test_the_camera_problem_builds_on_every_arrangement(data):
    config = compose("train", f"data={data}", "model=camera", "model.scorer.layers=[2]")
    served = build(config["data"], "data")
    problem = build(config["model"], "model").problem
    served.bind(problem)
    assert served.draw == problem.dataset
    assert problem.feature_size == config["model"]["problem"]["features"]


def test_the_camera_s_numbers_are_those_of_the_paper_s_table_of_hyperparameters():
    model = compose("train", "model=camera")["model"]
    assert model["optimizer"] == {"_target_": "torch.optim.Adam", "_partial_": True, "lr": 1e-4}
    assert model["temperature"] == 1.2
    assert [model["loss"][name] for name in ("alpha", "beta", "gamma")] == [1.0, 0.01, 0.0]
    assert model["scorer"]["layers"] == [1000, 900, 900]
    assert model["hypotheses"] == 100
    assert model["problem"]["frames"] == 80


@pytest.mark.parametrize("scale", choices("scale_of_t"))
def test_the_length_of_t_has_its_choices(scale):
    model = compose(
        "train",
        "model=camera",
        f"scale_of_t@model.problem.scale={scale}",
        "model.scorer.layers=[2]",
    )
    kinds = {"known": "KnownScale", "height": "BodyHeight", "segments": "BoneLengths"}
    assert type(build(model["model"], "model").problem.scale).__name__ == kinds[scale]


@pytest.mark.parametrize("data", choices("data"))
def test_every_test_configuration_builds(data):
    config = compose("test", f"data={data}")
    assert build(config["data"], "data").name == data
    assert sorted(build(config["baselines"], "baselines")) == [
        "adaptive_ransac",
        "frame_learned",
        "linear",
        "lo_ransac",
        "m_estimator",
        "ransac",
        "weighted_linear",
    ]
    assert sorted(build(config["camera_baselines"], "camera_baselines")) == [
        "eight_point",
        "five_point",
        "poselib",
        "ransac",
        "rig",
        "usac_accurate",
        "usac_magsac",
        "weight_refined",
    ]


def test_the_adaptive_ransac_of_the_tables_is_everyone_s():
    config = compose("predict")
    users = (
        config["predictor"]["learned"]["average"]["consensus"],
        *(config["predictor"][kind]["flips"]["estimator"] for kind in ("classical", "learned")),
    )
    assert all(settings == config["baselines"]["adaptive_ransac"] for settings in users)


@pytest.mark.parametrize("experiment", choices("experiment"))
def test_an_experiment_changes_one_setting_and_says_which_ablation_it_is(experiment):
    def leaves(node, path=""):
        if not isinstance(node, dict):
            return {path: node}
        return {
            k: v for name, value in node.items() for k, v in leaves(value, f"{path}.{name}").items()
        }

    usual, changed = leaves(compose("train")), leaves(compose("train", f"experiment={experiment}"))
    assert sum(usual[key] != changed[key] for key in usual) == 1
    assert usual.keys() == changed.keys()
    assert (
        (CONF / f"experiment/{experiment}.yaml")
        .read_text()
        .splitlines()[1]
        .startswith("# Ablation")
    )


def test_the_numbers_are_those_of_the_paper_s_table_of_hyperparameters():
    config = compose("train", "data=h36m", "model=pose")
    model, loss = config["model"], config["model"]["loss"]
    assert model["optimizer"] == {"_target_": "torch.optim.Adam", "_partial_": True, "lr": 5e-4}
    assert model["temperature"] == 1.5
    assert (loss["alpha"], loss["beta"], loss["gamma"]) == (1.0, 0.01, 0.02)
    assert model["scorer"]["layers"] == [1000, 900, 900, 900, 700]
    assert model["hypotheses"] == 200
    assert config["data"]["batch_size"] == 16
    assert config["data"]["train_samples"] == 500
    assert config["trainer"]["max_epochs"] == 1  # "500 iterations correspond to 500 data samples"


def test_the_arrangements_are_those_of_section_4():
    assert {
        name: compose("train", f"data={name}")["data"]["cameras"]
        for name in ("cmu1", "cmu2", "cmu3", "cmu4")
    } == {
        "cmu1": [1, 2, 3, 4, 6, 7, 10],
        "cmu2": [12, 16, 18, 19, 22, 23, 30],
        "cmu3": [10, 12, 16, 18],
        "cmu4": [6, 7, 10, 12, 16, 18, 19, 22, 23, 30],
    }


@pytest.mark.parametrize("name", ["train", "test"])
def test_the_help_names_every_choice(name):
    text = (
        (CONF / f"{name}.yaml").read_text().split("== Choices ==")[1].split("== Configuration")[0]
    )
    for group in ("data", "model", "experiment") if name == "train" else ("data",):
        assert all(choice in text for choice in choices(group))
