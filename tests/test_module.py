"""The loop on a problem without cameras or people: the module knows only the contract."""

from dataclasses import dataclass
from functools import partial

import lightning as L
import pytest
import torch
from torch.utils.data import DataLoader

from ghpt import randomness
from ghpt.errors import GhptConfigError, GhptError
from ghpt.models.aggregation import AGGREGATIONS
from ghpt.models.loss import StochasticLoss
from ghpt.models.module import StochasticEstimator
from ghpt.models.problem import Problem
from ghpt.models.scorer import Scorer


@dataclass
class Numbers:
    sample: torch.Tensor
    truth: torch.Tensor

    def __len__(self):
        return len(self.sample)

    def to(self, device):
        return Numbers(self.sample.to(device), self.truth.to(device))


class GuessTheNumber:
    """Hypotheses are the truth plus noise; the feature is the noise, so a scorer can learn to
    prefer little of it.
    """

    measures, feature_size = "distance", 1

    def generate(self, batch, count, keys):
        return batch.truth[:, None] + 10 * (randomness.uniform(keys, (count,)).float() - 0.3)

    def featurize(self, hypotheses):
        return (hypotheses - hypotheses.round(decimals=-3))[..., None]

    def aggregate(self, hypotheses, weights):
        return (weights * hypotheses).sum(-1)

    def as_estimates(self, hypotheses):
        return hypotheses

    def error(self, estimate, batch):
        truth = batch.truth.reshape(-1, *[1] * (estimate.dim() - 1))
        return (estimate - truth).abs(), torch.ones(len(batch), dtype=torch.bool)


class NumbersData(L.LightningDataModule):
    def batches(self):
        return [Numbers(torch.arange(16) + 16 * i, 1000.0 * torch.arange(1, 17)) for i in range(10)]

    def train_dataloader(self):
        return DataLoader(self.batches(), batch_size=None)

    def val_dataloader(self):
        return DataLoader(self.batches()[:2], batch_size=None)

    def all_training_batches(self):
        return iter(self.batches())


def module(**changes):
    settings = {
        "problem": GuessTheNumber(),
        "scorer": partial(Scorer, layers=[16], clip=10.0, bfloat16=False),
        "loss": StochasticLoss(alpha=1.0, beta=0.01, gamma=0.02, relative_errors=True),
        "optimizer": partial(torch.optim.Adam, lr=0.02),
        "hypotheses": 20,
        "temperature": 1.5,
        "gumbel": True,
        "logit_std_cap": 1.5,
        "selection": "weight",
        "seed": 0,
    }
    return StochasticEstimator(**(settings | changes))


def trainer(tmp_path, epochs=8):
    return L.Trainer(
        accelerator="cpu",
        max_epochs=epochs,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=tmp_path,
        num_sanity_val_steps=0,
    )


@pytest.mark.parametrize("changes", [{}, {"gumbel": False}, {"selection": "stochastic"}])
def test_training_makes_the_weighted_selection_better_than_the_average(tmp_path, changes):
    assert isinstance(GuessTheNumber(), Problem)
    run = trainer(tmp_path)
    run.fit(module(**changes), datamodule=NumbersData())
    weight, average = (
        run.callback_metrics[f"validation/{n}"].item() for n in ("weight", "average")
    )
    assert weight < 0.6 * average


def test_test_step_gives_every_selection_and_a_summary(tmp_path):
    model = module()
    model.fit_statistics(iter(NumbersData().batches()))
    batch = NumbersData().batches()[0]
    with torch.no_grad():
        estimates, summary = model.test_step(batch, 0)
    assert tuple(estimates) == AGGREGATIONS
    errors = {name: model.problem.error(e, batch)[0] for name, e in estimates.items()}
    for name in ("most", "least", "stochastic", "random"):
        assert (errors["best"] <= errors[name]).all()
        assert (errors[name] <= errors["worst"]).all()
    assert (
        (summary["entropy"] >= 0) & (summary["entropy"] <= torch.log(torch.tensor(20.0)) + 1e-5)
    ).all()
    assert ((summary["effective"] >= 1 - 1e-5) & (summary["effective"] <= 20 + 1e-4)).all()


def test_draws_do_not_depend_on_batch_mates():
    model = module()
    batch = NumbersData().batches()[0]
    half = Numbers(batch.sample[3:7], batch.truth[3:7])
    with torch.no_grad():
        whole, part = model.test_step(batch, 0)[0], model.test_step(half, 0)[0]
    for name in AGGREGATIONS:
        torch.testing.assert_close(whole[name][3:7], part[name])


def test_test_has_no_gumbel_noise_and_training_has():
    model = module()
    batch = NumbersData().batches()[0]
    keys = model.keys("x", batch)
    pool = model.pool(batch, keys)
    noisy = model.terms(pool, batch, keys).stochastic
    model.gumbel = False
    assert not torch.allclose(noisy, model.terms(pool, batch, keys).stochastic)


def test_a_loss_that_is_not_finite_stops_with_the_samples(tmp_path):
    class Broken(GuessTheNumber):
        def featurize(self, hypotheses):
            return torch.full((*hypotheses.shape, 1), torch.nan)

    with pytest.raises(GhptError, match=r"the loss is nan.*\[0, 1, 2"):
        trainer(tmp_path, 1).fit(module(problem=Broken()), datamodule=NumbersData())


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"hypotheses": 0}, "hypotheses"),
        ({"temperature": 0.0}, "temperature"),
        ({"selection": "best"}, "selection"),
    ],
)
def test_out_of_range_settings_are_named(change, key):
    with pytest.raises(GhptConfigError, match=rf"model\.{key}"):
        module(**change)
