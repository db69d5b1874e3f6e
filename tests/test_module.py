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
from ghpt.models.problem import Hypotheses, Problem
from ghpt.models.scorer import Scorer
from ghpt.observations import Batch, Labelled, Samples


@dataclass(frozen=True)
class Guess(Batch):
    number: torch.Tensor


@dataclass(frozen=True)
class Guesses(Hypotheses):
    number: torch.Tensor


@dataclass(frozen=True)
class Numbers(Samples):
    """The observed number is the true one."""

    number: torch.Tensor


class GuessTheNumber(Problem):
    """Hypotheses are the truth plus noise; the feature is the noise, so a scorer can learn to
    prefer little of it.
    """

    measures, feature_size = "distance", 1

    def generate(self, observations, count, keys):
        noise = 10 * (randomness.uniform(keys, (count,)).float() - 0.3)
        return Guesses(observations.number[:, None] + noise)

    def featurize(self, hypotheses):
        return (hypotheses.number - hypotheses.number.round(decimals=-3))[..., None]

    def aggregate(self, hypotheses, weights):
        return Guess((weights * hypotheses.number).sum(-1))

    def as_estimates(self, hypotheses):
        return Guess(hypotheses.number)

    def error(self, estimate, truth):
        true = truth.number.reshape(-1, *[1] * (estimate.number.dim() - 1))
        return (estimate.number - true).abs(), torch.ones(len(true), dtype=torch.bool)


def labelled(index, number):
    return Labelled(Numbers(index, number), Guess(number))


class NumbersData(L.LightningDataModule):
    def batches(self):
        return [
            labelled(torch.arange(16) + 16 * i, 1000.0 * torch.arange(1, 17)) for i in range(10)
        ]

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


def test_a_pool_gives_every_estimate_and_a_summary_of_the_weights():
    model = module()
    model.fit_statistics(batch.observations for batch in NumbersData().batches())
    batch = NumbersData().batches()[0]
    with torch.no_grad():
        pool = model.test_step(batch, 0)
        summary = pool.weight_summary()
        errors = {
            name: model.problem.error(pool.estimate(name), batch.truth)[0] for name in AGGREGATIONS
        }
    for name in ("most", "least", "stochastic", "random"):
        assert (errors["best"] <= errors[name]).all()
        assert (errors[name] <= errors["worst"]).all()
    assert (summary.entropy >= 0).all()
    assert (summary.entropy <= torch.log(torch.tensor(20.0)) + 1e-5).all()
    assert (summary.effective >= 1 - 1e-5).all()
    assert (summary.effective <= 20 + 1e-4).all()


def test_the_first_hypotheses_are_those_of_a_smaller_pool():
    batch = NumbersData().batches()[0]
    with torch.no_grad():
        first = module().test_step(batch, 0).first(7)
        small = module(hypotheses=7).test_step(batch, 0)
    assert torch.equal(first.errors, small.errors)
    for name in AGGREGATIONS:
        assert torch.equal(first.weights(name), small.weights(name))


def test_a_temperature_is_that_of_a_model_that_has_it():
    batch = NumbersData().batches()[0]
    with torch.no_grad():
        warm = module().test_step(batch, 0).with_temperature(7.0)
        model = module(temperature=7.0).test_step(batch, 0)
    assert torch.equal(warm.weights(), model.weights())
    assert not torch.equal(warm.weights(), warm.with_temperature(1.5).weights())


def test_without_a_truth_only_best_and_worst_are_refused():
    with torch.no_grad():
        pool = module().sample(NumbersData().batches()[0].observations, "use")
    possible = [name for name in AGGREGATIONS if name not in ("best", "worst")]
    assert all(pool.weights(name).shape == (16, 20) for name in possible)
    with pytest.raises(ValueError, match="no truth"):
        pool.estimate("best")


def test_logits_are_the_scorers_and_weights_are_made_of_capped_ones():
    model = module(logit_std_cap=1e-3)
    batch = NumbersData().batches()[0]
    with torch.no_grad():
        pool = model.test_step(batch, 0)
        raw = model.scorer(model.problem.featurize(pool.hypotheses))
    assert torch.equal(pool.logits, raw)
    assert pool.capped_logits.std(dim=-1).max() < 2e-3
    torch.testing.assert_close(pool.weights(), torch.full((16, 20), 1 / 20), rtol=0, atol=1e-3)


def test_draws_do_not_depend_on_batch_mates():
    model = module()
    batch = NumbersData().batches()[0]
    with torch.no_grad():
        whole, part = model.test_step(batch, 0), model.test_step(batch.rows(slice(3, 7)), 0)
    for name in AGGREGATIONS:
        torch.testing.assert_close(whole.estimate(name).number[3:7], part.estimate(name).number)


def test_test_has_no_gumbel_noise_and_training_has():
    model = module()
    batch = NumbersData().batches()[0]
    pool = model.sample(batch.observations, "x", batch.truth)
    noisy = model.terms(pool, pool.keys).stochastic
    model.gumbel = False
    assert not torch.allclose(noisy, model.terms(pool, pool.keys).stochastic)


def test_a_loss_that_is_not_finite_stops_with_the_samples(tmp_path):
    class Broken(GuessTheNumber):
        def featurize(self, hypotheses):
            return torch.full((*hypotheses.number.shape, 1), torch.nan)

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
