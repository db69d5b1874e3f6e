"""A6, outputs: no name inside the data decides where anything is written."""

import importlib.util

import pytest

from ghpt.export import WRITERS, Scene, read_reconstruction
from reconstructions import about, in_parts, random_reconstruction, rig

NAMES = [
    "..",
    ".",
    "../up",
    "/absolute",
    "\\\\server\\share",
    "C:\\windows",
    "line\nbreak",
    "tab\there",
    "nul\0byte",
    "a b",
    "x" * 255,
    "é" * 127,
    "膝",
    "=1+1",
    "-rf",
    "%s%n",
    "'; drop",
    "</script>",
    "{brace}",
    "~",
    "con",
    "a:b",
    "*?",
]
PACKAGE = {"parquet": "pyarrow", "rerun": "rerun"}


def tree(folder):
    """All files below a folder and their content."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.mark.parametrize("format", list(WRITERS))
def test_a6_names_never_write_outside_the_output(tmp_path, monkeypatch, format, record_row):
    if format in PACKAGE and importlib.util.find_spec(PACKAGE[format]) is None:
        pytest.skip(f"{PACKAGE[format]} is not installed: ghpt[io], ghpt[viz]")
    inside, elsewhere = tmp_path / "a" / "out", tmp_path / "a"
    inside.mkdir(parents=True)
    (elsewhere / "up").write_text("mine", encoding="utf-8")
    monkeypatch.chdir(inside)
    made = random_reconstruction(3, joints=len(NAMES), views=len(NAMES), seed=1)
    who = about(joints=NAMES, cameras=NAMES)
    object.__setattr__(who, "name", "../../name")
    settings = {"scene": Scene(rig(len(NAMES)))} if format in ("html", "rerun") else {}
    WRITERS[format].write(inside / WRITERS[format].file, who, in_parts(made), **settings)
    outside = set(tree(tmp_path)) - {f"a/out/{WRITERS[format].file}", "a/up"}
    record_row(
        "A6", f"{format}: {len(NAMES)} names, {len(outside)} files outside", int(not outside), 1
    )
    assert outside == set()
    assert (elsewhere / "up").read_text(encoding="utf-8") == "mine"


@pytest.mark.parametrize("format", ["trc", "csv"])
def test_a6_names_stay_in_their_cells(tmp_path, format):
    who, made = about(joints=NAMES), random_reconstruction(3, joints=len(NAMES), seed=1)
    path = tmp_path / WRITERS[format].file
    WRITERS[format].write(path, who, in_parts(made))
    lines = path.read_text(encoding="utf-8").split("\n")
    assert len(lines) == (6 if format == "trc" else 1) + 3 + 1


def test_a6_npz_gives_the_names_back(tmp_path):
    names = [name for name in NAMES if not name.endswith("\0")]
    who = about(joints=names, cameras=names)
    made = random_reconstruction(3, joints=len(names), views=len(names), seed=1)
    WRITERS["npz"].write(tmp_path / "poses.npz", who, in_parts(made))
    assert read_reconstruction(tmp_path / "poses.npz")[0] == who


@pytest.mark.posix
@pytest.mark.parametrize("format", ["npz", "csv", "trc", "c3d", "html"])
def test_a6_a_link_in_the_output_s_place_is_replaced_not_followed(tmp_path, format):
    precious, path = tmp_path / "precious", tmp_path / WRITERS[format].file
    precious.write_text("mine", encoding="utf-8")
    path.symlink_to(precious)
    WRITERS[format].write(path, about(), in_parts(random_reconstruction(3)))
    assert precious.read_text(encoding="utf-8") == "mine"
    assert not path.is_symlink()
