"""The ablations: pools and temperatures on a toy, the tasks of each artefact, and what is said of
made-up numbers.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch

from ghpt.config import build
from ghpt.files import write_json
from ghpt.metrics.pose_error import MPJPE
from ghpt.models.checkpoint import load_model
from ghpt.paper.ablations.actions import measure_pools
from ghpt.paper.ablations.tables import ARTEFACTS
from ghpt.paper.engine.artefact import Results, Section
from ghpt.paper.engine.setup import Setup
from ghpt.paper.engine.tasks import read_json
from sections import markdown
from sections import setup as whole_setup
from toys import DATA, TRAIN, train

BY_LABEL = {artefact.label: artefact for artefact in ARTEFACTS}
SIZES = {
    "stride": {"validation": 512, "test": 512},
    "also_trained_on": ["cmu3"],
    "temperature": [0.5, 5.0],
    "hypotheses": [10, 1000],
    "hypotheses_trained": [20],
    "samples": [50, 5000],
    "samples_hypotheses": 20,
}


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """A folder with a model trained on the toy with 12 hypotheses, and the toy's configuration."""
    folder = tmp_path_factory.mktemp("toy")
    data = DATA | {"cache": str(folder / "cache")}
    train(TRAIN | {"data": data, "trainer": TRAIN["trainer"] | {"max_epochs": 1}}, folder)
    return folder, data


def evaluated(
    toy: tuple[Path, dict[str, Any]], settings: Sequence[Sequence[Any]], out: Path
) -> list[dict[str, float]]:
    folder, data = toy
    pools = [{"hypotheses": count, "temperature": value} for count, value in settings]
    config = {"splits": {"test": data}, "pools": pools, "seed": 0}
    measure_pools(config, {"model": folder}, out)
    return read_json(out / "result.json")["test"]


def test_the_beginning_of_a_pool_is_the_pool_of_so_many_hypotheses(toy, tmp_path: Path):
    counts = (3, 12, 40)
    ours = evaluated(toy, [[count, None] for count in counts], tmp_path)
    folder, data = toy
    module = build(data, "data")
    module.setup("test")
    frames = module.frames["test"]
    batch = frames[range(len(frames))]
    for count, errors in zip(counts, ours, strict=True):
        model = load_model(folder / "last.ckpt", hypotheses=count, seed=0)[0].eval()
        pool = model.sample(batch.observations, "test", batch.truth)
        for name, error in errors.items():
            metric = MPJPE("relative", 1, 17)
            group = torch.zeros_like(batch.observations.index)
            metric.update(pool.estimate(name), batch.truth, group)
            assert error == pytest.approx(metric.compute().mean.item(), rel=1e-5)
    assert ours[0]["best"] > ours[1]["best"] > ours[2]["best"]


def test_a_high_temperature_is_the_average_and_the_default_is_the_models_own(toy, tmp_path: Path):
    own, same, hot = evaluated(toy, [[None, None], [12, 1.5], [None, 1e6]], tmp_path)
    assert own == same
    assert hot["weight"] == pytest.approx(hot["average"], rel=1e-5)
    assert abs(own["weight"] - own["average"]) > 1e-3


def setup(seed: int = 0, **sizes: Any) -> Setup:
    return whole_setup(seed, ablation=SIZES | sizes)


def section(
    label: str, error: Callable[[int, str, str, int], float], folder: Path, seeds: int = 1
) -> Section:
    """Of tasks in which ``weight`` has ``error(seed, task, split, setting)``, the average 40 and
    the best 20 mm.
    """
    setups = [setup(seed) for seed in range(seeds)]
    tasks = [BY_LABEL[label].tasks(one) for one in setups]
    for one, by_name in zip(setups, tasks, strict=True):
        for name, task in by_name.items():
            own = task.folder(folder)
            own.mkdir(parents=True, exist_ok=True)
            write_json(own / "task.json", {"seconds": 90.0 + 20 * one.seed})
            if "splits" in task.config:
                result = {
                    split: [
                        {"weight": error(one.seed, name, split, i), "average": 40.0, "best": 20.0}
                        for i in range(len(task.config["pools"]))
                    ]
                    for split in task.config["splits"]
                }
                write_json(own / "result.json", result)
    return BY_LABEL[label].section(Results(setups, tasks, folder))


@pytest.mark.parametrize(("label", "settings"), [("gumbel", 2), ("features", 3), ("selection", 2)])
def test_each_setting_is_trained_twice_and_the_default_is_the_reports_own_model(
    label: str, settings: int
):
    tasks = BY_LABEL[f"ablation-{label}"].tasks(setup())
    assert (
        len({task.dependencies["model"].key for task in tasks.values()})
        == len(tasks)
        == 2 * settings
    )
    defaults = {
        data: next(task for name, task in tasks.items() if name.startswith(data))
        for data in ("h36m", "cmu3")
    }
    for data, task in defaults.items():
        assert task.dependencies["model"].key == setup().training(data).key
    assert set(defaults["cmu3"].config["splits"]) == {"test"}
    others = [
        task.dependencies["model"].config for name, task in tasks.items() if "default" not in name
    ]
    assert all(config["model"] != setup().training("h36m").config["model"] for config in others)


@pytest.mark.parametrize(
    ("label", "keys", "trained"),
    [
        ("temperature", ("model", "temperature"), {0.5, 1.5, 5.0}),
        ("hypotheses", ("model", "hypotheses"), {20, 200}),
        ("samples", ("data", "train_samples"), {50, 500, 5000}),
    ],
)
def test_each_quantity_is_what_the_models_are_trained_with(
    label: str, keys: tuple[str, str], trained: set[float]
):
    tasks = BY_LABEL[f"ablation-{label}"].tasks(setup())
    models = [
        task.dependencies["model"].config
        for name, task in tasks.items()
        if name not in ("model", "cmu3")
    ]
    assert {config[keys[0]][keys[1]] for config in models} == trained
    assert len(models) == len(trained)


def test_a_table_says_what_validation_chooses_and_what_that_is_worth(tmp_path: Path):
    def error(seed: int, task: str, split: str, setting: int) -> float:
        better = ("without" in task) == (split == "validation")
        return (20.0 if better else 25.0) + seed

    found = section("ablation-gumbel", error, tmp_path, seeds=2)
    assert "Validation would choose: without." in markdown(found)
    assert "without: -19.6 %, +24.4 %, +24.4 %." in markdown(found)
    assert "20.5 ± 0.7" in markdown(found)
    assert "| average of the same pool " in markdown(found)
    assert found.data == "synthetic Human3.6M"
    equal = section(
        "ablation-gumbel", lambda seed, task, split, i: 20.0 + 0.1 * ("default" in task), tmp_path
    )
    assert "Validation keeps the default." in markdown(equal)


def test_a_table_without_another_training_set_has_none(tmp_path: Path):
    tasks = BY_LABEL["ablation-features"].tasks(setup(also_trained_on=[]))
    assert len(tasks) == 3
    assert all(name.startswith("h36m") for name in tasks)


def test_five_hundred_samples_are_enough_only_where_no_other_number_is_better(tmp_path: Path):
    def falls(seed: int, task: str, split: str, setting: int) -> float:
        return {"50": 35.0, "500": 30.0, "5000": 25.0}[task]

    enough, minutes = section("ablation-samples", falls, tmp_path).claims
    assert not enough.holds
    assert (
        enough.evidence
        == "30.0 mm of 500; the best of 50, 500, 5000 is 5000 with 25.0 mm (-16.7 %)"
    )
    assert minutes.holds
    assert "90 s" in minutes.evidence
    enough, _ = section("ablation-samples", lambda seed, task, split, i: 30.0, tmp_path).claims
    assert enough.holds


@pytest.mark.parametrize(
    ("label", "places"),
    [
        ("temperature", [0.5, 1.5, 5.0]),
        ("hypotheses", [10, 200, 1000]),
        ("samples", [50, 500, 5000]),
    ],
)
def test_a_figure_has_validation_and_test_on_logarithmic_axes(
    label: str, places: list[float], tmp_path: Path
):
    found = section(f"ablation-{label}", lambda seed, task, split, i: 30.0 + i, tmp_path)
    ((name, figure),) = found.figures.items()
    assert f"](figures/{name}.svg)" in markdown(found)
    assert "synthetic Human3.6M" in figure.get_suptitle()
    assert len(figure.axes) == 2
    for axes in figure.axes:
        assert axes.get_xscale() == "log"
        assert list(axes.containers[0].lines[0].get_xdata()) == places
    assert "(default)" in markdown(found)
    assert "Validation " in markdown(found)
