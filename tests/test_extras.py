"""What only some estimators need is not installed with ghpt."""

import logging
import sys

import pytest

from ghpt.config import CONF, build, read_yaml
from ghpt.errors import GhptConfigError
from ghpt.extras import EXTRAS, build_installed, check_installed

BASELINES = read_yaml(CONF / "baselines" / "default.yaml", "baselines")
PAIRS = read_yaml(CONF / "camera_baselines" / "default.yaml", "camera_baselines")


@pytest.mark.parametrize("package", EXTRAS)
def test_a_missing_package_is_named_with_its_extra(package, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(GhptConfigError) as caught:
        check_installed(package, "this")
    assert package in caught.value.problem
    assert f"'ghpt[{EXTRAS[package]}]'" in caught.value.hint


def test_a_named_estimator_without_its_package_is_an_error(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(GhptConfigError):
        build(BASELINES["lo_ransac"], "baselines.lo_ransac")


def test_a_test_goes_on_without_the_rows_of_missing_packages(monkeypatch, caplog) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    group = {name: PAIRS[name] for name in ("eight_point", "usac_magsac", "poselib")}
    with caplog.at_level(logging.WARNING):
        built = build_installed(group, "camera_baselines")
    assert list(built) == ["eight_point", "poselib"]
    (said,) = caplog.messages
    assert "ghpt[opencv]" in said
