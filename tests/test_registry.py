"""What a checkpoint may build: what the project's own configurations name, and classes of trusted
packages.
"""

import copy
import importlib
import itertools
import logging
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

import sections
import toys
from ghpt.errors import GhptCheckpointError, GhptConfigError
from ghpt.models.checkpoint import FIELD, load_model, read_checkpoint
from ghpt.models.module import StochasticEstimator
from ghpt.models.registry import PARTS, build_registered, packages_to_trust
from ghpt.paper.ablations.tables import ARTEFACTS
from ghpt.paper.engine.setup import compose
from ghpt.paper.engine.tasks import with_dependencies
from signing import save_signed
from toys import train

CONF = Path(__file__).resolve().parents[1] / "conf"
ABLATED = {
    "stride": {"validation": 512, "test": 512},
    "also_trained_on": [],
    "temperature": [0.5],
    "hypotheses": [10],
    "hypotheses_trained": [20],
    "samples": [50],
    "samples_hypotheses": 20,
}
SCORERS = '''
"""A scorer and a loss of the user's own."""

import torch
from torch import nn

from ghpt.models.loss import LossTerms
from ghpt.models.pose.problem import PoseTriangulation
from ghpt.models.scorer import Scorer, Standardise

IMPORTED = []


class Linear(nn.Module):
    """One weight for each feature; no annotations."""

    def __init__(self, size, clip, slope=1.0):
        super().__init__()
        self.standardise = Standardise(size, clip)
        self.network = nn.Linear(size, 1)
        self.slope = slope

    def forward(self, features):
        return self.slope * self.network(self.standardise(features))[..., 0]


class Expected(nn.Module):
    """The expected error alone."""

    def forward(self, weights, errors, estimate_error):
        expected = (weights * errors).sum(-1)
        return LossTerms(expected, expected, 0 * expected, 0 * expected)


class Wrapped(nn.Module):
    """A scorer of ghpt within one's own."""

    def __init__(self, size, inner):
        super().__init__()
        self.inner = inner(size)
        self.standardise = self.inner.standardise

    def forward(self, features):
        return self.inner(features)


class NoModule:
    """Not of the kind that a scorer is."""


class Wide(PoseTriangulation):
    """A problem derived from one of ours."""

    def __init__(self, factor, **settings):
        super().__init__(**settings)
        self.factor = factor

    def featurize(self, hypotheses):
        return self.factor * super().featurize(hypotheses)


def function(size, clip, slope):
    return Linear(size, clip, slope)
'''


def of_conf() -> dict[str, dict[str, Any]]:
    """The model of every choice of conf/."""
    found = {}
    for model in sorted(path.stem for path in (CONF / "model").glob("*.yaml")):
        groups = {"experiment": "experiment", "scale_of_t": "scale_of_t@model.problem.scale"}
        group = "scale_of_t" if model == "camera" else "experiment"
        choices = sorted(path.stem for path in (CONF / group).glob("*.yaml"))
        if model in ("joint", "key_points"):  # the experiments are of the paper's models
            choices = []
        for choice in (None, *choices):
            words = (f"model={model}", *([f"{groups[group]}={choice}"] if choice else []))
            found[f"{model} {choice}"] = compose(CONF, "train", words)["model"]
    return found


def of_the_ablations() -> dict[str, dict[str, Any]]:
    """The model of every training that reproduce.py changes something in."""
    small = sections.setup(ablation=ABLATED)
    tasks = with_dependencies(
        itertools.chain.from_iterable(item.tasks(small).values() for item in ARTEFACTS)
    )
    return {
        task.name: task.config["model"]
        for task in tasks.values()
        if task.action.endswith(".train_model")
    }


@pytest.mark.parametrize("models", [of_conf, of_the_ablations])
def test_every_model_of_ours_is_registered(models: Callable[[], dict[str, dict[str, Any]]]) -> None:
    found = models()
    assert len(found) >= 8
    for name, model in found.items():
        small = copy.deepcopy(model)
        if "layers" in small["scorer"]:
            small["scorer"]["layers"] = [2]
        assert isinstance(build_registered(small), StochasticEstimator), name


@pytest.mark.parametrize("name", ["Adam", "AdamW", "SGD", "adam.Adam"])
def test_optimizers_are_registered_by_name(name: str) -> None:
    optimizer = {"_target_": f"torch.optim.{name}", "_partial_": True, "lr": 0.1}
    built = build_registered(toys.MODEL | {"optimizer": optimizer}).configure_optimizers()
    assert type(built).__name__ == name.rpartition(".")[2]
    assert all(
        issubclass(c, torch.optim.Optimizer) for c in PARTS["model.optimizer"].classes.values()
    )


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A package of the user's, ``mine``, that Python finds."""
    package = tmp_path / "code" / "mine"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "scorers.py").write_text(SCORERS)
    (package / "losses.py").write_text(
        "from mine.scorers import Expected as Base\n\n\nclass Expected(Base):\n    pass\n"
    )
    (package / "broken.py").write_text("raise OSError('no such device')\n")
    monkeypatch.syspath_prepend(str(package.parent))
    importlib.invalidate_caches()
    yield package
    forget()


def forget() -> None:
    """As a new process, that has not imported the package."""
    for name in [name for name in sys.modules if name.split(".")[0] == "mine"]:
        del sys.modules[name]


SCORER = {"_target_": "mine.scorers.Linear", "_partial_": True, "clip": 10.0, "slope": 2.0}
INNER = toys.MODEL["scorer"]
OWN = {
    "scorer": {"scorer": SCORER},
    "loss": {"loss": {"_target_": "mine.scorers.Expected"}},
    "problem": {
        "problem": toys.MODEL["problem"] | {"_target_": "mine.scorers.Wide", "factor": 2.0}
    },
    "ours within one's own": {
        "scorer": {"_target_": "mine.scorers.Wrapped", "_partial_": True, "inner": INNER}
    },
}


def settings(**model: Any) -> dict[str, Any]:
    config = copy.deepcopy(toys.TRAIN)
    config["model"] |= model
    config["trainer"]["max_epochs"] = 1
    return config


@pytest.mark.parametrize("name", OWN)
def test_a_model_of_one_s_own_trains_and_tests(tmp_path: Path, own: Path, name: str) -> None:
    config = settings(**OWN[name])
    train(config, tmp_path)
    forget()
    baselines = {"linear": {"_target_": "ghpt.models.estimators.classical.Linear"}}
    again = config | {
        "ckpt": str(tmp_path / "last.ckpt"),
        "hypotheses": None,
        "baselines": baselines,
    }
    result = toys.run_test(again | {"trust": ["mine.scorers"]}, tmp_path / "tested")
    assert result.error > 0
    forget()
    with pytest.raises(
        GhptCheckpointError, match=r"needs classes of mine\.scorers.*'trust=\[mine\.scorers\]'"
    ):
        toys.run_test(again, tmp_path / "tested")
    assert not [name for name in sys.modules if name.split(".")[0] == "mine"]


def test_training_goes_on_and_says_what_to_trust(
    tmp_path: Path, own: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Its configuration is what the user typed: it needs no trust."""
    config = settings(scorer=SCORER)
    with caplog.at_level(logging.INFO, "ghpt.commands.train"):
        train(config, tmp_path)
    assert any(
        "python test.py ckpt=" in said and said.endswith(" 'trust=[mine.scorers]'")
        for said in caplog.messages
    )
    config["trainer"]["max_epochs"] = 2
    train(config | {"resume": True}, tmp_path)
    assert read_checkpoint(tmp_path / "last.ckpt")["epoch"] == 1


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """A checkpoint."""
    folder = tmp_path_factory.mktemp("trained")
    train(settings(), folder)
    return read_checkpoint(folder / "last.ckpt")


@pytest.fixture
def checkpoint_of(tmp_path: Path, trained: dict[str, Any]) -> Callable[..., Path]:
    """``checkpoint_of(**model)``: a checkpoint whose model has other settings."""

    def write(**model: Any) -> Path:
        changed = copy.deepcopy(trained)
        changed[FIELD]["config"]["model"] |= model
        save_signed(changed, tmp_path / "own.ckpt")
        return tmp_path / "own.ckpt"

    return write


def test_all_packages_are_named_at_once(own: Path, checkpoint_of: Callable[..., Path]) -> None:
    path = checkpoint_of(scorer=SCORER, loss={"_target_": "mine.losses.Expected"})
    with pytest.raises(GhptCheckpointError, match=r"'trust=\[mine\.losses,mine\.scorers\]'"):
        load_model(path)
    with pytest.raises(GhptCheckpointError, match=r"'trust=\[mine\.scorers,mine\.losses\]'"):
        load_model(path, ["mine.scorers"])
    assert "mine" not in sys.modules


def test_a_package_has_all_its_modules_trusted(
    own: Path, checkpoint_of: Callable[..., Path]
) -> None:
    path = checkpoint_of(loss={"_target_": "mine.losses.Expected"})
    model, _ = load_model(path, ["mine"])
    assert type(model.loss).__module__ == "mine.losses"


def test_a_problem_of_one_s_own_is_derived_from_problem(
    own: Path, checkpoint_of: Callable[..., Path]
) -> None:
    path = checkpoint_of(problem={"_target_": "mine.scorers.NoModule"})
    with pytest.raises(GhptCheckpointError, match=r"is no ghpt\.models\.problem\.Problem"):
        load_model(path, ["mine.scorers"])


@pytest.mark.parametrize(
    ("trust", "model", "reason"),
    [
        ("mine.scorer", SCORER, r"'trust=\[mine\.scorer,mine\.scorers\]'"),
        (
            "mine.scorers",
            SCORER | {"_target_": "mine.scorers.function"},
            "mine.scorers.function is no class",
        ),
        (
            "mine.scorers",
            SCORER | {"_target_": "mine.scorers.NoModule"},
            r"is no torch\.nn\.modules\.module\.Module",
        ),
        (
            "mine.scorers",
            SCORER | {"_target_": "mine.scorers.Scorer"},
            r"defined elsewhere, in ghpt\.models\.scorer",
        ),
        (
            "mine.scorers",
            SCORER | {"_target_": "mine.scorers.torch.nn.Identity"},
            r"'trust=\[mine|defined elsewhere",
        ),
        (
            "mine.scorers",
            SCORER | {"_target_": "mine.scorers.Nothing"},
            "no class 'mine.scorers.Nothing'",
        ),
        ("mine.scorers", SCORER | {"_partial_": False}, "_partial_: is not True"),
        (
            "mine",
            SCORER | {"_target_": "mine.broken.Scorer"},
            r"cannot be imported \(OSError: no such device\)",
        ),
        ("mine", SCORER | {"_target_": "mine.nothing.Scorer"}, "no class 'mine.nothing.Scorer'"),
        (
            "mine",
            SCORER | {"_target_": "os.path.join"},
            "is no class that a checkpoint may name here",
        ),
        (
            "mine",
            SCORER | {"_target_": "ghpt.files.sweep_temporaries"},
            "is no class that a checkpoint may name here",
        ),
    ],
)
def test_only_classes_of_a_trusted_package_are_built(
    own: Path, checkpoint_of: Callable[..., Path], trust: str, model: dict[str, Any], reason: str
) -> None:
    path = checkpoint_of(scorer=model)
    with pytest.raises(GhptCheckpointError, match=reason):
        load_model(path, [trust])


@pytest.mark.parametrize(
    "name",
    [
        "os",
        "builtins",
        "subprocess",
        "ghpt",
        "ghpt.files",
        "torch",
        "torch.nn",
        "__main__",
        "",
        ".",
        "*",
        "mine.",
        ".mine",
        "mine scorers",
        "mine,os",
        "mine\n",
    ],
)
def test_what_is_not_the_user_s_own_cannot_be_trusted(
    checkpoint_of: Callable[..., Path], name: str
) -> None:
    with pytest.raises(GhptConfigError, match=r"trust: .* is no module of your own"):
        load_model(checkpoint_of(), [name])


def test_a_trusted_package_is_not_imported_for_a_checkpoint_of_ours(
    own: Path, checkpoint_of: Callable[..., Path]
) -> None:
    load_model(checkpoint_of(), ["mine"])
    assert "mine" not in sys.modules


def test_the_commands_take_trust(
    tmp_path: Path,
    own: Path,
    checkpoint_of: Callable[..., Path],
    typed: Callable[..., tuple[int, str, str]],
) -> None:
    path = checkpoint_of(scorer=SCORER)
    for command in ("test", "predict"):
        module = importlib.import_module(f"ghpt.commands.{command}")
        words = (
            f"ckpt={path}",
            "trust=[mine.scorers]",
            f"output={tmp_path / 'out'}",
            "progress_bar=false",
        )
        said = typed(CONF, module.COMMAND, words)[2]
        # Its weights are those of another scorer: it has been built.
        assert "does not fit its own model (weights scorer" in said


def test_training_warns_of_a_class_that_no_checkpoint_may_name(
    own: Path, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    with caplog.at_level(logging.WARNING, "ghpt.commands.train"):
        train(
            settings(scorer=SCORER | {"_target_": "mine.scorers.function", "slope": 1.0}), tmp_path
        )
    assert any(
        "will not take this model: model.scorer._target_: mine.scorers.function is no class" in said
        for said in caplog.messages
    )


def test_nothing_of_ours_needs_trust() -> None:
    assert packages_to_trust(toys.MODEL) == []
