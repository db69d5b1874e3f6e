"""What a researcher plugs into a training: loggers, callbacks, schedulers, scorers, searches."""

import csv
import math

import pytest
from torch.optim.lr_scheduler import CosineAnnealingLR

import ghpt.extras
import toys
from composed import compose
from ghpt.commands.jobs import Job
from ghpt.commands.train import TrainSettings, objective
from ghpt.config import settings
from ghpt.errors import GhptConfigError
from ghpt.models.module import StochasticEstimator

SMALL = ("model.hypotheses=5", "model.scorer.layers=[4]", "trainer=cpu", "progress_bar=false")


def plugged(*words):
    return compose("train", *SMALL, *words) | {"data": toys.DATA}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a run that overfits one batch."""
    folder = tmp_path_factory.mktemp("plugs")
    words = ("logger=many", "callbacks=many", "scheduler=cosine", "trainer.max_epochs=3")
    values = plugged(*words, "debug=overfit", "trainer.max_epochs=3")
    values["callbacks"]["early_stopping"] |= {"patience": 1, "min_delta": 1000.0}
    toys.train(values, folder)
    return folder


@pytest.fixture(scope="module")
def curves(run):
    """The rows of metrics.csv."""
    with open(run / "csv" / "metrics.csv", encoding="utf-8", newline="") as handle:
        return list(csv.DictReader(handle))


def test_two_loggers_show_a_run(run, curves):
    assert len(list(run.glob("*tfevents*"))) == 1
    assert [row["train/total"] for row in curves if row["train/total"]]


def test_the_learning_rate_is_logged_as_it_is_scheduled(curves):
    rates = [float(row["lr-Adam"]) for row in curves if row["lr-Adam"]]
    expected = [5e-4 * (1 + math.cos(math.pi * step / 32)) / 2 for step in range(len(rates))]
    assert rates == pytest.approx(expected, rel=1e-6)


def test_a_run_that_overfits_has_one_step_an_epoch_and_stops_early(curves):
    steps = [int(row["step"]) for row in curves if row["validation/weight"]]
    assert steps == [0, 1]


def test_lightning_s_own_method_loads_a_checkpoint(run):
    model = StochasticEstimator.load_from_checkpoint(run / "last.ckpt", hypotheses=7)
    assert model.hypotheses == 7
    assert model.schedule.func is CosineAnnealingLR


@pytest.mark.parametrize(
    ("words", "key"),
    [
        (("best.monitor=validation/wieght",), "best.monitor"),
        (
            ("callbacks=early_stopping", "callbacks.early_stopping.monitor=loss"),
            "callbacks.early_stopping.monitor",
        ),
        (("trainer.precision=half",), "trainer.precision"),
        (("logger=none", "callbacks=lr_monitor"), "trainer"),
    ],
)
def test_a_setting_that_cannot_work_is_named(words, key, tmp_path):
    with pytest.raises(GhptConfigError) as caught:
        toys.train(plugged(*words), tmp_path)
    assert caught.value.key == key


def test_a_logger_without_its_package_is_named(tmp_path):
    if ghpt.extras.is_installed("wandb"):
        pytest.skip("wandb is installed here")
    with pytest.raises(GhptConfigError) as caught:
        toys.train(plugged("logger=wandb"), tmp_path)
    assert (caught.value.key, "ghpt[wandb]" in caught.value.hint) == ("logger.wandb", True)


def test_a_search_is_given_the_error_of_the_best_metric():
    values = plugged("best.monitor=validation/average") | {"output": "unused"}
    errors = {"validation/weight": 20.0, "validation/average": 23.0}
    assert objective(settings(TrainSettings, values), errors) == 23.0
    assert float(Job("0", None, errors, "", failed=False, objective=23.0)) == 23.0
    assert math.isnan(float(Job("0", None, None, "", failed=True)))


def test_another_scorer_stands_in_the_place_of_the_model_s():
    values = compose("train", "scorer@model.scorer=key_points")
    assert values["model"]["scorer"] == compose("train", "model=key_points")["model"]["scorer"]
