"""HDF5 of SLEAP, DeepLabCut and anipose as their tools write it, without their packages."""

import json
import pickle
import sys

import numpy as np
import pytest

from ghpt.data.formats.key_points import read_key_points
from ghpt.data.formats.pickled_names import read_names
from ghpt.errors import GhptDataError

NAMES = tuple(
    f"{side}_{part}"
    for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
    for side in ("left", "right")
)
RNG = np.random.default_rng(0)
POINTS = RNG.uniform(1, 500, (5, 2, len(NAMES), 2))
"""Of 5 frames and 2 people."""
SURE = RNG.uniform(0.1, 1, POINTS.shape[:3])


def columns(people: int) -> list[tuple[str, ...]]:
    whose = [()] if people == 1 else [("anna",), ("ben",)]
    return [
        ("DLC_net", *who, name, coordinate)
        for who in whose
        for name in NAMES
        for coordinate in ("x", "y", "likelihood")
    ]


def table(people: int) -> np.ndarray:
    values = np.concatenate([POINTS, SURE[..., None]], -1)[:, :people]
    return values.reshape(len(values), -1)


def sleap(h5py, path, as_matlab=True):
    with h5py.File(path, "w") as file:
        file["node_names"] = np.array(NAMES, "S")
        tracks = POINTS.transpose(1, 3, 2, 0) if as_matlab else POINTS
        file.create_dataset("tracks", data=tracks, compression="gzip")
        file["point_scores"] = SURE.transpose(1, 2, 0) if as_matlab else SURE


def pandas_rows(h5py, path, people=2, protocol=0):
    """As DeepLabCut's to_hdf(format="table")."""
    names, values = columns(people), table(people)
    rows = np.zeros(len(values), [("index", "<i8"), ("values_block_0", "<f8", values.shape[1:])])
    rows["index"] = np.arange(len(values)) + 3
    rows["values_block_0"] = values
    with h5py.File(path, "w") as file:
        group = file.create_group("df_with_missing")
        group.attrs["pandas_type"] = np.bytes_(b"frame_table")
        group["table"] = rows
        group["table"].attrs["values_block_0_kind"] = np.void(pickle.dumps(names, protocol))


def pandas_blocks(h5py, path, people=2):
    """As to_hdf() without a format, which anipose's and older files have."""
    names, values = columns(people), table(people)
    with h5py.File(path, "w") as file:
        group = file.create_group("df_with_missing")
        group.attrs["pandas_type"] = np.bytes_(b"frame")
        group.attrs["nblocks"] = 1
        group.attrs["block0_items_nlevels"] = len(names[0])
        for level, own in enumerate(zip(*names, strict=True)):
            there = sorted(set(own))
            group[f"block0_items_level{level}"] = np.array(there, "S")
            labels = [there.index(name) for name in own]
            group[f"block0_items_label{level}"] = np.array(labels, np.int8)
        group["block0_values"] = values
        group["axis1"] = np.arange(len(values)) + 3


def sleap_labels(h5py, path):
    """As SLEAP saves a project: the second person of the last frame was put right by hand."""
    path = path.with_suffix(".slp")
    nodes = [{"id": index} for index in reversed(range(len(NAMES)))]
    names = [{"name": name} for name in reversed(NAMES)]
    points, sure = POINTS.reshape(10, -1, 2), SURE.reshape(10, -1)
    predicted = np.zeros(
        (11, len(NAMES)), [*((n, "f8") for n in "xy"), ("visible", "?"), ("score", "f8")]
    )
    predicted["x"][:10], predicted["y"][:10] = points[..., 0], points[..., 1]
    predicted["score"][:10], predicted["visible"] = sure, True
    instances = np.zeros(11, [(name, "i8") for name in _INSTANCE])
    instances["instance_id"] = np.arange(11)
    instances["instance_type"] = 1
    instances["frame_id"] = [*np.repeat(np.arange(5), 2), 4]
    instances["track"] = [*np.tile([0, 1], 5), 1]
    instances["from_predicted"] = -1
    instances["point_id_start"] = np.arange(11) * len(NAMES)
    instances["point_id_end"] = instances["point_id_start"] + len(NAMES)
    instances[10] = (10, 0, 4, 1, 9, 0, len(NAMES))
    by_hand = predicted[9].copy()
    frames = np.zeros(5, [("frame_id", "u8"), ("frame_idx", "u8"), ("video", "u4")])
    frames["frame_id"], frames["frame_idx"] = np.arange(5), np.arange(5) + 2
    with h5py.File(path, "w") as file:
        metadata = {"nodes": names, "skeletons": [{"nodes": nodes}]}
        file.create_group("metadata").attrs["json"] = np.bytes_(json.dumps(metadata).encode())
        file["metadata"].attrs["format_id"] = 1.4
        file["frames"], file["instances"] = frames, instances
        file["pred_points"] = predicted.reshape(-1)
        file["points"] = by_hand[["x", "y", "visible"]].copy()


_INSTANCE = (
    "instance_id",
    "instance_type",
    "frame_id",
    "track",
    "from_predicted",
    "point_id_start",
    "point_id_end",
)


def test_what_was_put_right_by_hand_counts_in_place_of_the_prediction(tmp_path):
    h5py = pytest.importorskip("h5py")
    sleap_labels(h5py, tmp_path / "cam1.slp")
    found = read_key_points(tmp_path)
    assert found.frame.tolist() == [2, 3, 4, 5, 6]
    assert found.identity.tolist() == [0, 1] * 5
    np.testing.assert_array_equal(found.points.pixels, POINTS.reshape(10, -1, 2))
    sure = SURE.reshape(10, -1).copy()
    sure[9] = 1
    np.testing.assert_array_equal(found.points.confidence, sure)


@pytest.mark.parametrize(
    ("write", "people", "first"),
    [
        (sleap, 2, 0),
        (lambda *to: sleap(*to, as_matlab=False), 2, 0),
        (pandas_rows, 2, 3),
        (lambda *to: pandas_rows(*to, people=1, protocol=5), 1, 3),
        (pandas_blocks, 2, 3),
        (lambda *to: pandas_blocks(*to, people=1), 1, 3),
    ],
)
def test_everybody_is_read(write, people, first, tmp_path):
    h5py = pytest.importorskip("h5py")
    for view in ("top", "side"):
        (tmp_path / view).mkdir()
        write(h5py, tmp_path / view / f"s1_{view}.analysis.h5")
    found = read_key_points(tmp_path)
    assert found.views == ("side", "top")
    assert found.joints == NAMES
    assert found.frame.tolist() == list(range(first, first + 5))
    points = np.concatenate([POINTS[:, :people].reshape(-1, 12, 2)] * 2)
    np.testing.assert_array_equal(found.points.pixels, points)
    sure = np.concatenate([SURE[:, :people].reshape(-1, 12)] * 2)
    np.testing.assert_array_equal(found.points.confidence, sure)


def test_who_is_not_there_is_missing_and_filtered_files_are_read(tmp_path):
    h5py = pytest.importorskip("h5py")
    for folder in ("pose-2d", "pose-2d-filtered"):
        (tmp_path / folder).mkdir()
        for view in ("a", "b"):
            pandas_blocks(h5py, tmp_path / folder / f"{view}.h5")
            with h5py.File(tmp_path / folder / f"{view}.h5", "a") as file:
                values = file["df_with_missing/block0_values"]
                values[2, :36] = np.nan
                values[...] += folder == "pose-2d"
    found = read_key_points(tmp_path)
    assert found.counts().tolist() == [[2, 2], [2, 2], [1, 1], [2, 2], [2, 2]]
    np.testing.assert_array_equal(found.points.pixels[:2], POINTS[0])


def test_what_lies_in_another_file_or_claims_much_is_refused(tmp_path):
    h5py = pytest.importorskip("h5py")
    for kind in ("external", "huge", "virtual", "other"):
        path = tmp_path / f"{kind}.h5"
        with h5py.File(path, "w") as file:
            file["node_names"] = np.array(NAMES, "S")
            if kind == "external":
                file["tracks"] = h5py.ExternalLink("/etc/hostname", "x")
            elif kind == "huge":
                shape = (1, 2, len(NAMES), 10**8)
                file.create_dataset("tracks", shape, "f8", chunks=(1, 2, len(NAMES), 100))
            elif kind == "virtual":
                layout = h5py.VirtualLayout((1, 2, len(NAMES), 5), "f8")
                layout[...] = h5py.VirtualSource("x.h5", "x", (1, 2, len(NAMES), 5))
                file.create_virtual_dataset("tracks", layout)
        with pytest.raises(GhptDataError, match=kind):
            read_key_points(path)


def test_without_h5py_the_command_that_installs_it_is_told_before_the_work(tmp_path, monkeypatch):
    (tmp_path / "cam1.h5").write_bytes(b"\x89HDF\r\n\x1a\n")
    monkeypatch.setitem(sys.modules, "h5py", None)
    for form in (None, "deeplabcut", "sleap", "anipose"):
        with pytest.raises(GhptDataError, match=r"need the package h5py.*pip install h5py"):
            read_key_points(tmp_path, format=form)


@pytest.mark.parametrize("protocol", range(6))
def test_names_are_read_from_a_pickle_that_is_not_run(protocol):
    names = columns(2)
    assert read_names(pickle.dumps(names, protocol)) == names


class Hostile:
    def __reduce__(self):
        return print, ("it runs",)


@pytest.mark.parametrize(
    "content", [Hostile(), [("a", Hostile())], ["a"], {"a": 1}, [("a", 1)], [("a", b"b")], 3]
)
@pytest.mark.parametrize("protocol", [0, 2, 5])
def test_a_pickle_of_anything_else_is_refused(content, protocol, capsys):
    with pytest.raises((ValueError, IndexError, KeyError)):
        read_names(pickle.dumps(content, protocol))
    assert capsys.readouterr().out == ""
