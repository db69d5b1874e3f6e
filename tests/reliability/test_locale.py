"""C6: what is written is the same, byte by byte, in every locale, encoding and time zone."""

import shutil
import subprocess
from dataclasses import dataclass, field
from pathlib import Path

import pytest

import children
import sizes

SCRIPT = Path(__file__).with_name("write_all.py")


@dataclass(frozen=True)
class Place:
    """An environment to write in, and the decimal point there."""

    point: str
    changes: dict[str, str] = field(default_factory=dict)
    is_forked: bool = True


PLACES = {
    "tr_TR.UTF-8": Place(",", {"LC_ALL": "tr_TR.UTF-8", "TZ": "Asia/Kathmandu"}),
}
if sizes.NIGHTLY:  # Python settles when it starts how it encodes, and to start takes seconds
    plain_c = {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
    PLACES["C.UTF-8"] = Place(".", {"LC_ALL": "C.UTF-8"})
    PLACES["de_DE.UTF-8"] = Place(",", {"LC_ALL": "de_DE.UTF-8"})
    PLACES["C"] = Place(".", plain_c, is_forked=False)


def make_locale(folder: Path, name: str) -> None:
    """Make a locale there, or skip the test where the system lacks the sources or the tool."""
    if shutil.which("localedef") is None:
        pytest.skip("needs localedef")
    language, encoding = name.split(".")
    command = ["localedef", "-i", language, "-f", encoding, str(folder / name)]
    subprocess.run(command, capture_output=True)
    if not (folder / name).is_dir():
        pytest.skip(f"the system has no sources of {name}")


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files as they are written here."""
    folder = tmp_path_factory.mktemp("here")
    children.output_of(SCRIPT, folder)
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("name", PLACES)
def test_c6_outputs_are_the_same_in_every_locale(tmp_path, reference, record_row, name):
    pytest.importorskip("pyarrow", reason="pyarrow writes Parquet; it comes with ghpt[test]")
    place = PLACES[name]
    if place.point == ",":
        make_locale(tmp_path, name)
    folder = tmp_path / "written"
    folder.mkdir()
    environment = {"LOCPATH": str(tmp_path), **place.changes}
    said = children.output_of(SCRIPT, folder, env=environment, is_forked=place.is_forked)
    assert said.strip() == place.point
    written = {path.name: path.read_bytes() for path in folder.iterdir()}
    differ = [file for file, content in reference.items() if written[file] != content]
    figure = (
        f"{len(written)} formats in {name}, decimal point {place.point!r}: {len(differ)} differ"
    )
    record_row("C6", figure, len(written) - len(differ), len(written))
    assert len(written) == 6
    assert differ == []
