"""B2: a run that was stopped anywhere and resumed ends with the numbers of one that was not."""

import copy

import pytest
import torch

import sizes
import toys
from ghpt.errors import GhptCheckpointError
from ghpt.models.callbacks import SaveLast
from ghpt.models.module import StochasticEstimator
from toys import train


class Crash(Exception):
    pass


def settings(workers=0, **changes):
    config = copy.deepcopy(toys.TRAIN) | {"save_every": 1} | changes
    config["data"] |= {
        "workers": workers,
        "train_samples": 70,
    }  # 5 steps an epoch, the last one short
    config["trainer"]["max_epochs"] = 3
    return config


def result(folder):
    return torch.load(folder / "last.ckpt", weights_only=True)


def difference(a, b):
    """Largest absolute difference over weights, optimiser moments and the best validation error;
    inf if they differ in kind.
    """
    if a["global_step"] != b["global_step"] or a["epoch"] != b["epoch"]:
        return float("inf")
    worst = max(
        (a["state_dict"][k].double() - b["state_dict"][k].double()).abs().max()
        for k in a["state_dict"]
    )
    for i, state in a["optimizer_states"][0]["state"].items():
        other = b["optimizer_states"][0]["state"][i]
        worst = max(worst, *((state[k] - other[k]).abs().max() for k in state))
    best = [
        next(v for k, v in c["callbacks"].items() if "ModelCheckpoint" in k)["best_model_score"]
        for c in (a, b)
    ]
    return max(float(worst), abs(float(best[0] - best[1])))


def crash_after_step(monkeypatch, step):
    original = SaveLast.on_train_batch_end

    def crash(self, trainer, *args):
        original(self, trainer, *args)
        if trainer.global_step == step:
            raise Crash

    monkeypatch.setattr(SaveLast, "on_train_batch_end", crash)


def crash_in_validation(monkeypatch, batch):
    original = StochasticEstimator.validation_step

    def crash(self, data, batch_idx):
        if self.trainer.current_epoch == 1 and batch_idx == batch:
            raise Crash
        return original(self, data, batch_idx)

    monkeypatch.setattr(StochasticEstimator, "validation_step", crash)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    return train(settings(), folder), result(folder)


@pytest.mark.parametrize(
    ("where", "workers"),
    sizes.representatives(
        [("step 7", 2), ("step 5", 0), ("step 1", 0), ("validation 1", 0)],
        [("step 7", 0), ("step 10", 2), ("step 15", 0), ("validation 0", 0)],
    ),
)
def test_resumed_equals_uninterrupted(tmp_path, uninterrupted, where, workers, record_row):
    kind, number = where.split()
    with pytest.MonkeyPatch.context() as patch:
        (crash_after_step if kind == "step" else crash_in_validation)(patch, int(number))
        with pytest.raises(Crash):
            train(settings(workers), tmp_path)
    metrics = train(settings(workers, resume=True), tmp_path)
    worst = difference(result(tmp_path), uninterrupted[1])
    record_row("B2", f"{where}, {workers} workers: max |difference| {worst:g}", int(worst == 0), 1)
    assert worst == 0
    assert metrics == uninterrupted[0]


def test_resume_of_a_resume_five_times(tmp_path, uninterrupted, record_row):
    for number, step in enumerate((2, 5, 8, 12, 14)):
        with pytest.MonkeyPatch.context() as patch:
            crash_after_step(patch, step)
            with pytest.raises(Crash):
                train(settings(resume=number > 0), tmp_path)
    metrics = train(settings(resume=True), tmp_path)
    worst = difference(result(tmp_path), uninterrupted[1])
    record_row("B2", f"resume of a resume x 5: max |difference| {worst:g}", int(worst == 0), 1)
    assert worst == 0
    assert metrics == uninterrupted[0]


def test_another_seed_gives_other_numbers(tmp_path, uninterrupted):
    """The comparison above can fail."""
    config = settings()
    config["model"]["seed"] = 1
    train(config, tmp_path)
    assert difference(result(tmp_path), uninterrupted[1]) > 1e-6


def test_resuming_with_other_settings_is_refused(tmp_path, uninterrupted):
    train(settings(), tmp_path)
    config = settings(resume=True)
    config["model"]["temperature"] = 2.0
    with pytest.raises(GhptCheckpointError, match="other settings of 'model'"):
        train(config, tmp_path)


def test_resuming_without_a_checkpoint_is_refused(tmp_path):
    with pytest.raises(GhptCheckpointError, match=r"last\.ckpt: there is no such file"):
        train(settings(resume=True), tmp_path)
