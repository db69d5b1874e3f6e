"""C6: what is written is the same, byte by byte, in every locale, encoding and time zone."""

import shutil
import subprocess
from pathlib import Path

import pytest

import children

SCRIPT = Path(__file__).with_name("write_all.py")
ENVIRONMENTS = {
    "C": {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"},
    "de_DE.UTF-8": {"LC_ALL": "de_DE.UTF-8", "TZ": "Asia/Kathmandu"},
    "tr_TR.UTF-8": {"LC_ALL": "tr_TR.UTF-8"},
}


def made_locale(folder, name):
    """Whether this locale could be made there: the system has the sources and the tool."""
    if shutil.which("localedef") is None:
        return False
    language, encoding = name.split(".")
    command = ["localedef", "-i", language, "-f", encoding, str(folder / name)]
    return subprocess.run(command, capture_output=True).returncode <= 1 and (folder / name).is_dir()


def test_c6_outputs_are_the_same_in_every_locale(tmp_path, record_row):
    pytest.importorskip("pyarrow", reason="pyarrow writes Parquet; it comes with ghpt[test]")
    written, points = {}, {}
    for name, changes in ENVIRONMENTS.items():
        made = name == "C" or made_locale(tmp_path, name)
        folder = tmp_path / f"out_{name}"
        folder.mkdir()
        environment = {"LOCPATH": str(tmp_path), **changes}
        if not made:
            environment["LC_ALL"] = (
                "C.UTF-8"  # setlocale would fail; the other changes are still tried
            )
        # whether Python is in UTF-8 mode is settled when it starts: a fork has that of its server
        said = children.output_of(SCRIPT, folder, env=environment, is_forked=name != "C")
        points[name] = said.strip()
        assert points[name] == ("," if made and name != "C" else ".")
        written[name] = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert len(written["C"]) == 6
    differ = [
        f"{name}/{file}"
        for name in written
        for file in written["C"]
        if written[name][file] != written["C"][file]
    ]
    commas = sum(point == "," for point in points.values())
    figure = f"6 formats in {len(written)} environments, {commas} of them with decimal commas: {len(differ)} differ"
    record_row(
        "C6", figure, len(written) - len({name.split("/")[0] for name in differ}), len(written)
    )
    assert differ == []
