"""Names of views and cameras in settings: what the user typed is found, whatever the command line
took it for.
"""

from typing import get_type_hints

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from ghpt.calibration.millimetres import ScaleSettings, read_scale
from ghpt.commands.inputs import InputSettings
from ghpt.config import check_type
from ghpt.data.formats.names import chosen_name
from ghpt.errors import GhptConfigError, GhptDataError
from test_key_points import camera_file, pairs

STRANGE = ("54138969", "01", "1e5", "true", "null", "1_000", "-3", "00_03", "1.50", "no")
INPUTS = get_type_hints(InputSettings)


def typed(word: str):
    """The value that Hydra makes of ``key=value``."""
    return OverridesParser.create().parse_override(word).value()


@pytest.mark.parametrize("name", STRANGE)
def test_a_view_is_found_as_it_was_typed(name):
    wanted = typed(f"views=[{name},cam]")
    check_type(wanted, INPUTS["views"], "views")
    views = (name, "cam", "other")
    assert pairs("pose", views, camera_file(views), {}, wanted) == [(0, 0), (1, 1)]


@pytest.mark.parametrize("name", STRANGE)
def test_match_takes_such_names_on_both_sides(name):
    match = typed(f"match={{{name}: a, b: {name}}}")
    check_type(match, INPUTS["match"], "match")
    assert pairs("pose", (name, "b"), camera_file((name, "a")), match, None) == [
        (1, 0),
        (0, 1),
    ]


@pytest.mark.parametrize("name", STRANGE)
def test_a_baseline_takes_such_names(name):
    baseline = typed(f"x=[{name},cam,3000]")
    source = read_scale(ScaleSettings(baseline=baseline), (name, "cam"))
    assert source.names == (name, "cam")
    with pytest.raises(GhptConfigError, match=r"scale\.baseline"):
        read_scale(ScaleSettings(baseline=typed("x=[5,cam,3000]")), (name, "cam"))


def test_a_leading_zero_of_yaml_is_found_and_an_exact_name_comes_first():
    assert chosen_name(7, ("07", "08")) == "07"
    assert chosen_name(7, ("07", "7")) == "7"
    assert chosen_name(float("nan"), ("nan", "a")) == "nan"


def test_two_names_that_are_read_alike_are_not_guessed():
    with pytest.raises(GhptDataError, match=r"no view 100000\.0 with a camera.*1e5, 100000"):
        pairs("pose", ("1e5", "100000"), camera_file(("1e5", "100000")), {}, typed("views=[1e5]"))
