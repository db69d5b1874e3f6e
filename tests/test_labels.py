"""karfly's labels: what the real file holds is read, and nothing else."""

import pickle
from pathlib import Path

import numpy as np
import pytest

import real_layout as layout
from ghpt.data.datasets.labels import read_labels
from ghpt.data.formats import restricted_pickle
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.errors import GhptDataError

RNG = np.random.default_rng(0)
TAKES = [
    ("S1", "Greeting-1", layout.person(RNG, 5, (0, 0, 1000))),
    ("S9", "Waiting-2", layout.person(RNG, 3, (0, 0, 900))),
]


@pytest.mark.parametrize("protocol", range(5))
@pytest.mark.parametrize("module_name", [b"numpy._core.multiarray", b"numpy.core.multiarray"])
def test_reads_what_numpy_1_and_2_write(tmp_path: Path, protocol: int, module_name: bytes) -> None:
    content = layout.human36m_labels(TAKES)
    layout.write_pickle(tmp_path / "l.npy", content, protocol)
    data = (tmp_path / "l.npy").read_bytes()
    if protocol < 4:  # length-prefixed strings of protocol 4 cannot be replaced
        data = data.replace(b"numpy._core.multiarray", module_name)
    (tmp_path / "l.npy").write_bytes(data)
    labels = read_labels(tmp_path / "l.npy")
    assert labels.subjects == ("S1", "S5", "S6", "S7", "S8", "S9", "S11")
    assert labels.cameras == ("54138969", "55011271", "58860488", "60457274")
    assert labels.actions == ("Greeting-1", "Waiting-2")
    assert labels.subject.tolist() == [0] * 5 + [5] * 3
    assert labels.action.tolist() == [0] * 5 + [1] * 3
    assert labels.frame.tolist() == [0, 5, 10, 15, 20, 0, 5, 10]
    assert np.array_equal(
        labels.key_points, np.concatenate([poses for *_, poses in TAKES]).astype("f4")
    )
    rig = human36m_rig("S9")
    for read, exact in (
        (labels.K, rig.cameras.K),
        (labels.R, rig.cameras.R),
        (labels.t, rig.cameras.t),
    ):
        assert np.array_equal(read[5], exact.numpy().astype("f4"))
    assert np.array_equal(labels.distortion[5], rig.distortion.numpy().astype("f4"))


def test_reads_numpy_save(tmp_path: Path) -> None:
    content = layout.human36m_labels(TAKES)
    np.save(tmp_path / "l.npy", content, allow_pickle=True)
    assert np.array_equal(read_labels(tmp_path / "l.npy").key_points, content["table"]["keypoints"])


def test_reads_a_fortran_ordered_and_a_big_endian_array(tmp_path: Path) -> None:
    content = layout.human36m_labels(TAKES)
    content["cameras"] = np.asfortranarray(content["cameras"])
    big = [
        (name, content["table"].dtype[name].newbyteorder(">"))
        for name in content["table"].dtype.names
    ]
    content["table"] = content["table"].astype(big)
    layout.write_pickle(tmp_path / "l.npy", content)
    labels = read_labels(tmp_path / "l.npy")
    assert np.array_equal(labels.K, content["cameras"]["K"])
    assert np.array_equal(labels.frame, content["table"]["frame_idx"])


def spoiled(**changes: object) -> dict:
    return layout.human36m_labels(TAKES) | changes


def table(**changes: object) -> np.ndarray:
    given = layout.human36m_labels(TAKES)["table"]
    for name, value in changes.items():
        given[name] = value
    return given


CAMERAS = layout.human36m_labels(TAKES)["cameras"]
BAD = {
    "a list": ([1, 2], "holds a list, not a dict"),
    "no names": (spoiled(subject_names=[]), "subject_names: is not a list of names"),
    "numbers for names": (
        spoiled(camera_names=[1, 2, 3, 4]),
        "camera_names: is not a list of names",
    ),
    "no actions": (
        {k: v for k, v in spoiled().items() if k != "action_names"},
        "action_names: is not",
    ),
    "no table": ({k: v for k, v in spoiled().items() if k != "table"}, "table: is missing"),
    "table of objects": (spoiled(table=np.array([{}], object)), "table: is not a numpy array"),
    "plain table": (spoiled(table=np.ones(3)), "table: holds float64, not records"),
    "table without points": (
        spoiled(table=table()[["subject_idx", "action_idx", "frame_idx"]]),
        "keypoints'.*missing",
    ),
    "32 joints": (
        spoiled(table=np.zeros(3, [*table().dtype.descr[:3], ("keypoints", "f4", (32, 3))])),
        "3 x 32 x 3",
    ),
    "subject 9": (
        spoiled(table=table(subject_idx=9)),
        "subject_idx'.*goes from 9 to 9, with 7 subject_names",
    ),
    "action -1": (spoiled(table=table(action_idx=-1)), "action_idx'.*goes from -1"),
    "6 subjects": (spoiled(cameras=CAMERAS[:6]), "cameras: has shape 6 x 4 instead of 7 x 4"),
    "no R": (spoiled(cameras=CAMERAS[["t", "K", "dist"]]), "cameras.'R'.*missing"),
    "4 coefficients": (
        spoiled(cameras=np.zeros((7, 4), [*CAMERAS.dtype.descr[:3], ("dist", "f4", 4)])),
        "7 x 4 x 4",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_wrong_content_is_named(tmp_path: Path, case: str) -> None:
    content, message = BAD[case]
    layout.write_pickle(tmp_path / "l.npy", content)
    with pytest.raises(GhptDataError, match=f"l.npy: .*{message}"):
        read_labels(tmp_path / "l.npy")


class Fake:
    """Pickles as a call of what it is given."""

    def __init__(self, *reduced: object) -> None:
        self.reduced = reduced

    def __reduce__(self) -> tuple:
        return self.reduced


def forged(dtype: np.dtype, shape: tuple, data: bytes) -> Fake:
    """An array whose pickle claims what it does not hold."""
    start = np.zeros(0, np.uint8).__reduce__()
    return Fake(start[0], start[1], (1, shape, dtype, False, data))


def forged_dtype(*state: object) -> Fake:
    return Fake(np.dtype, ("V8", False, True), state)


def laughs(levels: int, width: int) -> Fake:
    """A dtype of dtypes of dtypes ..., which is small in the file and huge when built."""
    inner: object = np.dtype("u1")
    for _ in range(levels):
        names = tuple(f"a{n}" for n in range(width))
        inner = forged_dtype(3, "|", None, names, dict.fromkeys(names, (inner, 0)), 8, 1, 0)
    return forged(inner, (1,), b"1" * 8)


FORGED = {
    "a million laughs": laughs(4, 100),
    "nested dtypes": laughs(50, 1),
    "1e9 elements": forged(np.dtype("f4"), (10**9,), b"1234"),
    "1e12-byte element": forged(
        forged_dtype(3, "|", None, ("a",), {"a": (np.dtype("f4"), 0)}, 10**12, 1, 0), (1,), b"1"
    ),
    "field beyond the end": forged(
        forged_dtype(3, "|", None, ("a",), {"a": (np.dtype("f8"), 96)}, 8, 1, 0), (1,), b"1" * 8
    ),
    "field before the start": forged(
        forged_dtype(3, "|", None, ("a",), {"a": (np.dtype("f8"), -8)}, 8, 1, 0), (1,), b"1" * 8
    ),
    "pointers as bytes": forged(
        forged_dtype(3, "|", None, ("a",), {"a": (np.dtype("O"), 0)}, 8, 1, 0), (1,), b"1" * 8
    ),
    "subarray of 1e15": forged(
        forged_dtype(3, "|", (np.dtype("f8"), (10**15,)), None, None, 8, 1, 0), (1,), b"1" * 8
    ),
    "no state": Fake(*np.zeros(3).__reduce__()[:2]),
    "a list as data": forged(np.dtype("f4"), (1,), [1.0]),
    "negative shape": forged(np.dtype("f4"), (-1, -1), b"1234"),
}


@pytest.mark.parametrize("case", FORGED)
def test_forged_arrays_are_refused(tmp_path: Path, case: str) -> None:
    layout.write_pickle(tmp_path / "l.npy", spoiled(table=FORGED[case]))
    with pytest.raises(GhptDataError, match="table: is not a numpy array"):
        read_labels(tmp_path / "l.npy")


BOMBS = {
    "memo of 2^32": b"N" + b"r\xff\xff\xff\xff" + b".",
    "bytes of 2^60": b"\x80\x04\x8e" + (1 << 60).to_bytes(8, "little") + b"abc.",
    "long of 2^31": b"\x80\x04\x8b" + (1 << 31).to_bytes(4, "little") + b"abc.",
    "nested 1e6 deep": b"(" * 10**6 + b"t" * 10**6 + b".",
    "frame of 2^60": b"\x80\x04\x95" + (1 << 60).to_bytes(8, "little") + b"N.",
    "unfinished": b"\x80\x04}",
    "empty": b"",
}


@pytest.mark.parametrize("case", BOMBS)
def test_bombs_are_refused(tmp_path: Path, case: str) -> None:
    layout.write_pickle(tmp_path / "l.npy", {})
    header = (tmp_path / "l.npy").read_bytes()[:128]
    (tmp_path / "l.npy").write_bytes(header + BOMBS[case])
    with pytest.raises(GhptDataError, match="is not a labels file"):
        read_labels(tmp_path / "l.npy")


def test_truncated_anywhere_is_refused(tmp_path: Path) -> None:
    layout.write_pickle(tmp_path / "l.npy", spoiled())
    data = (tmp_path / "l.npy").read_bytes()
    for length in {*range(0, len(data), 37), *range(300), len(data) - 1}:
        (tmp_path / "l.npy").write_bytes(data[:length])
        with pytest.raises(GhptDataError):
            read_labels(tmp_path / "l.npy")


def test_every_changed_byte_gives_labels_or_the_named_error(tmp_path: Path) -> None:
    layout.write_pickle(tmp_path / "l.npy", spoiled(table=table()[:1]))
    data = (tmp_path / "l.npy").read_bytes()
    rng = np.random.default_rng(1)
    refused = 0
    for place in range(0, len(data), 4):
        changed = data[:place] + bytes([data[place] ^ (1 << rng.integers(8))]) + data[place + 1 :]
        (tmp_path / "l.npy").write_bytes(changed)
        try:
            read_labels(tmp_path / "l.npy")
        except GhptDataError:
            refused += 1
    assert refused > 150


def test_a_plain_array_is_no_labels_file(tmp_path: Path) -> None:
    np.save(tmp_path / "l.npy", np.ones(3))
    with pytest.raises(GhptDataError, match="not a pickled dict"):
        read_labels(tmp_path / "l.npy")


def test_what_a_pickle_names_is_new_in_each_load() -> None:
    unpickler = restricted_pickle._Unpickler(__import__("io").BytesIO(pickle.dumps(None)))
    first, second = (unpickler.find_class("numpy", "dtype") for _ in range(2))
    assert first is not second
    assert first is not np.dtype
