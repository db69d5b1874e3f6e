"""A1, A2, A3: whatever happened to a file, it is read or named, in little time and memory; a cut
file never passes.

Each file is read in a child process with a limit of memory and a timer (``hostile.py``).
"""

import json
from pathlib import Path

import pytest

import children
import sizes

WORKER = Path(__file__).with_name("hostile.py")
FORMATS = (
    "openpose",
    "mmpose",
    "coco",
    "results",
    "easymocap",
    "rtmlib",
    "yolo",
    "caliscope",
    "npz",
    "npy",
    "freemocap",
    "toml",
    "yaml",
    "panoptic",
    "human36m",
    "colmap",
    "opencap",
    "camera_json",
    "camera_list",
    "camera_yml",
    "deeplabcut_csv",
    "sleap_csv",
)
HDF5 = ("sleap", "deeplabcut", "sleap_labels")
"""Read by h5py, which is an extra."""
GROUPS = (FORMATS[:8], FORMATS[8:13], FORMATS[13:])
TABLES = ("caliscope", "toml", "yaml", "camera_yml", "yolo", "deeplabcut_csv", "sleap_csv")
"""Cut between two lines they are whole, and shorter."""


def measured(row, formats, count, seed):
    return json.loads(children.output_of(WORKER, row, ",".join(formats), count, seed))


def of_all(found, *outcomes):
    return sum(form["outcomes"].get(outcome, 0) for form in found.values() for outcome in outcomes)


@pytest.mark.parametrize("formats", [*GROUPS, HDF5], ids="-".join)
def test_a_mutated_file_is_read_or_named(formats, record_row):
    if formats is HDF5:
        pytest.importorskip("h5py")
    found = measured("A1", formats, sizes.MUTATED_FILES, 0)
    for name, form in found.items():
        bad = {kind: n for kind, n in form["outcomes"].items() if kind in ("crash", "hang", "leak")}
        total = sum(form["outcomes"].values())
        record_row(
            "A1",
            f"{name}: 0 crashes, hangs, leaks; RSS + {form['grown_kib'] / 1024:.0f} MiB",
            total - sum(bad.values()),
            total,
        )
        assert not bad, (name, form["notes"])
        assert total == form["total"]
        assert (
            form["outcomes"]["named"] > 0.3 * total
        )  # most of what is spoilt is not a file of this kind any more
        assert form["grown_kib"] <= 64 * 1024 + 8 * form["file_kib"]


def test_our_own_key_points_never_come_back_different(record_row):
    found = measured("A2", ("npz",), sizes.MUTATED_NPZ, 7)
    total, bad = found["npz"]["total"], of_all(found, "different", "part", "leak", "hang", "crash")
    record_row("A2", "own npz: 0 read with other values", total - bad, total)
    assert not bad, found["npz"]["notes"]
    assert of_all(found, "same") > 0  # some bytes, such as dates, mean nothing


@pytest.mark.parametrize("formats", [*GROUPS, HDF5], ids="-".join)
def test_a_file_that_ends_early_is_named(formats, record_row):
    """Cut at bytes all over the file, every one at night. Tables and texts that end between two
    lines are shorter recordings or rigs without poses; nothing that is read is any other than in
    the whole file.
    """
    if formats is HDF5:
        pytest.importorskip("h5py")
    found = measured("A3", formats, sizes.CUT_FILES, 0)
    for name, form in found.items():
        accepted = form["outcomes"].get("part", 0) if name in TABLES else 0
        spaces = 12 if name in TABLES else 0  # the whole without what ends it
        bad = form["total"] - form["outcomes"]["named"] - accepted
        record_row(
            "A3",
            f"{name}: 0 read with other values, {accepted} cut between lines",
            form["total"] - bad,
            form["total"],
        )
        assert of_all({name: form}, "different", "leak", "hang", "crash") == 0, (
            name,
            form["notes"],
        )
        assert bad <= spaces
        assert accepted < 0.05 * form["total"]
