"""JSON files: one writer, and no number that JSON has no word for."""

import json
from pathlib import Path

from ghpt.files import write_json


def test_json_has_no_number_that_json_has_no_word_for(tmp_path):
    content = {
        "a": [float("nan"), 1.5, (float("inf"), -float("inf"))],
        "b": {"c": float("nan"), "d": None},
    }
    write_json(tmp_path / "a.json", content)

    def refuse(word):
        raise AssertionError(word)

    found = json.loads((tmp_path / "a.json").read_text(), parse_constant=refuse)
    assert found == {"a": [None, 1.5, [None, None]], "b": {"c": None, "d": None}}
    assert (tmp_path / "a.json").read_text().endswith("}\n")


def test_json_is_written_in_one_place():
    """Whatever writes JSON for people and programs goes through ``write_json``."""
    source = Path(__file__).parents[1] / "src" / "ghpt"
    writers = [path.name for path in source.rglob("*.py") if "json.dump(" in path.read_text()]
    assert writers == ["files.py"]
