import functools
import os
import re
from collections import OrderedDict
from dataclasses import dataclass, field
from typing import Literal

import pytest
import torch

from ghpt.commands.overrides import rename_settings
from ghpt.config import Target, build, check_plain, settings
from ghpt.errors import GhptConfigError, check
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


@dataclass(frozen=True)
class Lens:
    model: Literal["pinhole", "brown"]
    coefficients: tuple[float, ...]

    def __post_init__(self):
        check(len(self.coefficients) < 6, "coefficients", "are too many", "Give 5 or fewer.")


@dataclass(frozen=True)
class Camera:
    name: str | int
    size: tuple[int, int]
    focal: float | None
    lens: Lens | None
    estimator: Target
    views: tuple[str, ...] = ()
    lenses: dict[str, Lens] = field(default_factory=dict)


LENS = {"model": "brown", "coefficients": [1, 0.5]}
CAMERA = {
    "name": 7,
    "size": [640, 480],
    "focal": 1000,
    "lens": LENS,
    "estimator": SCORER,
}


def test_settings_are_typed_as_they_are_annotated():
    camera = settings(Camera, CAMERA | {"lenses": {"a": LENS}})
    lens = Lens("brown", (1.0, 0.5))
    assert camera == Camera(7, (640, 480), 1000.0, lens, SCORER, (), {"a": lens})
    assert [type(value) for value in (camera.name, camera.focal, camera.size[0])] == [
        int,
        float,
        int,
    ]


def test_an_optional_group_may_be_null():
    assert settings(Camera, CAMERA | {"lens": None, "focal": None}).lens is None


@pytest.mark.parametrize(
    ("changed", "key", "problem"),
    [
        ({"sise": 1}, "camera.sise", "no such setting"),
        ({"lens": {"model": "brown"}}, "camera.lens.coefficients", "is missing"),
        ({"lens": LENS | {"k": 1}}, "camera.lens.k", "no such setting"),
        ({"lens": LENS | {"model": "fish"}}, "camera.lens.model", "is 'fish', not one of"),
        ({"lens": 3}, "camera.lens", "is 3, not a group of settings"),
        ({"lens": [3]}, "camera.lens", r"is \[3\], not a group of settings"),
        ({"lenses": {"a": LENS | {"k": 1}}}, "camera.lenses.a.k", "no such setting"),
        ({"lens": LENS | {"coefficients": [0] * 6}}, "camera.lens.coefficients", "are too many"),
        ({"size": [640]}, "camera.size", "is"),
        ({"size": [640, 4.5]}, "camera.size", "is"),
        ({"focal": "wide"}, "camera.focal", "is 'wide', not a finite number or null"),
        ({"focal": float("nan")}, "camera.focal", "is nan"),
        ({"views": ["a", 3]}, "camera.views", "is"),
        ({"estimator": "scorer"}, "camera.estimator", "is 'scorer', not a group of settings"),
    ],
)
def test_a_setting_that_does_not_fit_is_named(changed, key, problem):
    with pytest.raises(GhptConfigError, match=rf"^{re.escape(key)}: {problem}"):
        settings(Camera, CAMERA | changed, "camera")


def test_a_setting_without_a_default_is_needed():
    with pytest.raises(GhptConfigError, match=r"^name: is missing\. "):
        settings(Camera, {key: value for key, value in CAMERA.items() if key != "name"})


def test_settings_that_are_gone_are_named():
    with pytest.raises(GhptConfigError, match=r"^view_weights\.power: is gone"):
        rename_settings(["data=h36m", "view_weights.power=4"])


def test_settings_by_their_former_names_are_understood():
    given = ["doctor.shift=20", "swaps=false", "model.spread=1", "-m", "output=a/doctor.x=1"]
    expected = ["camera_check.shift=20", "flips=false", "model.logit_std_cap=1", "-m"]
    assert rename_settings(given) == [*expected, "output=a/doctor.x=1"]
