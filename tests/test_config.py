import functools
import os
from collections import OrderedDict

import pytest
import torch

from ghpt.config import build, check_plain
from ghpt.errors import GhptConfigError
from ghpt.models.scorer import Scorer

SCORER = {
    "_target_": "ghpt.models.scorer.Scorer",
    "size": 3,
    "layers": [4, 5],
    "clip": 10.0,
    "bfloat16": False,
}


def test_builds_nested_and_partial():
    built = build({"a": [SCORER], "b": SCORER | {"_partial_": True}, "c": 3})
    assert isinstance(built["a"][0], Scorer)
    assert built["c"] == 3
    assert built["b"](clip=2.0).standardise.clip == 2.0


def test_an_unknown_argument_says_what_exists():
    with pytest.raises(
        GhptConfigError, match=r"model\.layer: Scorer has no such setting\. Did you mean 'layers'\?"
    ):
        build(SCORER | {"layer": 3}, "model")


def test_a_missing_argument_is_named():
    with pytest.raises(GhptConfigError, match="Scorer needs clip"):
        build({k: v for k, v in SCORER.items() if k != "clip"}, "model")


@pytest.mark.parametrize(
    "target", ["ghpt.models.scorer.Scorr", "ghpt.nothing.Scorer", "nothing", ""]
)
def test_an_unknown_target_is_named(target):
    with pytest.raises(GhptConfigError, match="no class"):
        build(SCORER | {"_target_": target})


def test_values_without_an_annotation_are_of_any_kind():
    assert build({"_target_": "test_config.Free", "a": 3, "b": "text", "c": None}) == (
        3,
        "text",
        None,
    )


def Free(a, b, c):
    return a, b, c


def test_interpolations_in_plain_data_stay_text(monkeypatch):
    monkeypatch.setitem(os.environ, "SECRET", "s3cret")
    assert build({"a": "${oc.env:SECRET}"}) == {"a": "${oc.env:SECRET}"}


@pytest.mark.parametrize(
    "value", [3, 2.5, True, None, "text", [], {}, [1, [2]], {"a": {"b": [3]}}, (1, 2), float("nan")]
)
def test_plain_data(value):
    check_plain(value, "config")


@pytest.mark.parametrize(
    ("value", "where"),
    [
        (torch.zeros(1), "config"),
        (b"bytes", "config"),
        ({1, 2}, "config"),
        (OrderedDict(a=1), "config"),
        ({"a": [0, 1j]}, r"config\.a\[1\]"),
        ({"a": {1: 2}}, r"config\.a"),
        ({"a": 1 << 70}, r"config\.a"),
        ([0] * 200_000, "config"),
        (functools.reduce(lambda inner, _: [inner], range(40), 0), "config"),
    ],
)
def test_what_is_not_plain_data_is_named(value, where):
    with pytest.raises(GhptConfigError, match=rf"^{where}: "):
        check_plain(value, "config")
