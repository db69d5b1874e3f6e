import os

import pytest
import torch

from ghpt.config import TRUSTED, build
from ghpt.errors import GhptConfigError
from ghpt.models.scorer import Scorer

SCORER = {"_target_": "ghpt.models.scorer.Scorer", "size": 3, "layers": [4, 5], "clip": 10.0, "bfloat16": False}


def test_builds_nested_and_partial():
    built = build({"a": [SCORER], "b": SCORER | {"_partial_": True}, "c": 3})
    assert isinstance(built["a"][0], Scorer)
    assert built["c"] == 3
    assert built["b"](clip=2.0).standardise.clip == 2.0


def test_an_unknown_argument_says_what_exists():
    with pytest.raises(GhptConfigError, match=r"model\.layer: Scorer has no such setting\. Did you mean 'layers'\?"):
        build(SCORER | {"layer": 3}, "model")


def test_a_missing_argument_is_named():
    with pytest.raises(GhptConfigError, match="Scorer needs clip"):
        build({k: v for k, v in SCORER.items() if k != "clip"}, "model")


@pytest.mark.parametrize("target", ["ghpt.models.scorer.Scorr", "ghpt.nothing.Scorer", "nothing", ""])
def test_an_unknown_target_is_named(target):
    with pytest.raises(GhptConfigError, match="no class"):
        build(SCORER | {"_target_": target})


@pytest.mark.parametrize(
    "target",
    ["os.system", "ghpt.files.os.system", "builtins.eval", "ghpt.config.importlib.import_module", "torch.load",
     "torch.optim.adam.torch.load", "logging.os.system", "ghpt.files.shutil.rmtree", "subprocess.Popen"],
)  # fmt: skip
def test_what_a_checkpoint_may_not_name(target):
    with pytest.raises(GhptConfigError):
        build({"_target_": target, "command": "true"}, packages=TRUSTED)


def test_what_a_checkpoint_may_name():
    build(SCORER, packages=TRUSTED)
    partial = build({"_target_": "torch.optim.Adam", "_partial_": True, "lr": 0.1}, packages=TRUSTED)
    assert isinstance(partial([torch.zeros(1, requires_grad=True)]), torch.optim.Adam)


def test_interpolations_in_plain_data_stay_text(monkeypatch):
    monkeypatch.setitem(os.environ, "SECRET", "s3cret")
    assert build({"a": "${oc.env:SECRET}"}, packages=TRUSTED) == {"a": "${oc.env:SECRET}"}
