"""Checks of users' cameras, arrays and files."""

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ghpt.data.formats.validate import check_cameras, check_names, read_json, read_npy, read_npz
from ghpt.errors import GhptDataError


def cameras(views: int = 3) -> dict[str, np.ndarray]:
    K = np.tile(np.array([[1100.0, 0.5, 500], [0, 1090, 510], [0, 0, 1]]), (views, 1, 1))
    R = Rotation.random(views, np.random.default_rng(0)).as_matrix()
    return {"K": K, "R": R, "t": np.ones((views, 3)), "distortion": np.zeros((views, 5))}


NAMES = ("a", "b", "c")


def test_good_cameras_pass_unchanged() -> None:
    given = cameras()
    checked, distortion = check_cameras("file", NAMES, **given)
    for name in ("K", "R", "t"):
        assert np.array_equal(getattr(checked, name).numpy(), given[name])
    assert np.array_equal(distortion, given["distortion"])


def test_rounded_rotation_becomes_the_nearest_one() -> None:
    given = cameras()
    exact = given["R"]
    given["R"] = exact.round(4)
    R = check_cameras("file", NAMES, **given)[0].R.numpy()
    assert np.abs(R @ R.mT - np.eye(3)).max() < 1e-14
    assert np.abs(R - exact).max() < 1e-4


def spoil(field: str, index: tuple, value: float) -> dict[str, np.ndarray]:
    given = cameras()
    given[field][index] = value
    return given


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (spoil("K", (1, 0, 0), np.nan), "file: camera b, K: holds a value that is not finite"),
        (spoil("R", (1, 0, 0), np.inf), "camera b, R: holds a value that is not finite"),
        (spoil("t", (2, 0), -np.inf), "camera c, t: holds a value that is not finite"),
        (
            spoil("distortion", (0, 4), np.nan),
            "camera a, distortion: holds a value that is not finite",
        ),
        (spoil("K", (0, 1, 1), -5), "camera a, K: the focal lengths are 1100 and -5"),
        (spoil("K", (0, 2, 0), 5), "camera a, K: is not of the form"),
        (spoil("K", (0, 1, 0), 5), "camera a, K: is not of the form"),
        (spoil("R", (0,), 2 * np.eye(3)), r"R is not a rotation \(\|R R\^T - I\| = 3, det = 8\)"),
        (spoil("R", (0,), np.diag([1, 1, -1])), "R is not a rotation .*det = -1"),
        (spoil("R", (0,), np.zeros((3, 3))), "R is not a rotation"),
        (cameras() | {"K": np.ones((3, 4, 3))}, "K: has shape 3 x 4 x 3 instead of 3 x 3 x 3"),
        (
            cameras() | {"t": np.array([["1"] * 3] * 3)},
            "t: holds <U1, not floating-point numbers or integers",
        ),
    ],
)
def test_bad_cameras_are_named(given: dict, message: str) -> None:
    with pytest.raises(GhptDataError, match=message):
        check_cameras("file", NAMES, **given)


def test_bad_lists_of_cameras() -> None:
    with pytest.raises(GhptDataError, match="camera 3 is listed twice"):
        check_names("file", [1, 3, 3])
    with pytest.raises(GhptDataError, match=r"there is no camera 7\. There are: 0, 1, 2"):
        check_names("file", [1, 7], range(3))
    with pytest.raises(GhptDataError, match="at least two"):
        check_names("file", [1])


@pytest.mark.parametrize(
    "array",
    [
        np.ones((4, 3), np.float32),
        np.asfortranarray(np.arange(15.0).reshape(5, 3)),
        np.ones((0, 3)),
    ],
)
def test_npy_is_read_as_numpy_reads_it(tmp_path: Path, array: np.ndarray) -> None:
    np.save(tmp_path / "a.npy", array)
    read = read_npy(tmp_path / "a.npy", (None, 3), "f")
    assert read.dtype == array.dtype
    assert np.array_equal(read, array)


def npy(array: object, allow: bool = False) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.asanyarray(array), allow_pickle=allow)
    return buffer.getvalue()


GOOD = npy(np.arange(12.0).reshape(4, 3))
BAD_NPY = {
    "empty": (b"", "is not a numpy array file"),
    "text": (b"1 2 3 4 5 6 7 8 9", "is not a numpy array file"),
    "one byte short": (GOOD[:-1], "claims 96 bytes of float64 and holds 95"),
    "one byte long": (GOOD + b"0", "claims 96 bytes of float64 and holds 97"),
    "huge claim": (
        GOOD.replace(b"(4, 3)", b"(4000000000000, 3)".ljust(6))[:300],
        "claims|damaged header",
    ),
    "negative": (GOOD.replace(b"(4, 3), }", b"(-4,-3),}"), "claims|damaged header"),
    "4 GiB header": (b"\x93NUMPY\x02\x00\xff\xff\xff\xff" + GOOD[12:], "header of more than"),
    "long header": (b"\x93NUMPY\x01\x00\xff\xff" + b" " * 70000, "header of more than"),
    "deep header": (b"\x93NUMPY\x01\x00\x00\x20" + b"(" * 0x2000, "damaged header"),
    "objects": (npy(np.array([{}], object), allow=True), "Python objects"),
    "integers": (npy(np.ones((4, 3), int)), "holds int64, not floating-point numbers"),
    "wrong shape": (npy(np.ones((4, 2))), "has shape 4 x 2 instead of any x 3"),
}


@pytest.mark.parametrize("case", BAD_NPY)
def test_bad_npy(tmp_path: Path, case: str) -> None:
    data, message = BAD_NPY[case]
    (tmp_path / "a.npy").write_bytes(data)
    with pytest.raises(GhptDataError, match=f"a.npy: .*({message})"):
        read_npy(tmp_path / "a.npy", (None, 3), "f")


def test_npy_truncated_anywhere_is_refused(tmp_path: Path) -> None:
    for length in range(len(GOOD)):
        (tmp_path / "a.npy").write_bytes(GOOD[:length])
        with pytest.raises(GhptDataError):
            read_npy(tmp_path / "a.npy", (None, 3), "f")


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(GhptDataError, match=r"gone\.npy: there is no such file"):
        read_npy(tmp_path / "gone.npy", (None,), "f")


FIELDS = {"x": ((None, 3), "f"), "n": ((None,), "iu")}


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_npz_is_read_as_numpy_reads_it(tmp_path: Path, save) -> None:
    x, n = np.random.default_rng(0).random((50, 3)), np.arange(4)
    save(tmp_path / "a.npz", x=x, n=n, other=np.ones(3))
    read = read_npz(tmp_path / "a.npz", FIELDS)
    assert set(read) == {"x", "n"}
    assert np.array_equal(read["x"], x)
    assert np.array_equal(read["n"], n)


def test_npz_truncated_anywhere_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez_compressed(path, x=np.ones((2, 3)), n=np.arange(4))
    data = path.read_bytes()
    for length in range(len(data)):
        path.write_bytes(data[:length])
        with pytest.raises(GhptDataError, match=r"a\.npz"):
            read_npz(path, FIELDS)


def test_a_flipped_bit_in_an_npz_is_never_read_as_data(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    good = {"x": np.random.default_rng(0).random((5, 3)), "n": np.arange(4)}
    np.savez(path, **good)
    data = path.read_bytes()
    for place in range(len(data)):
        path.write_bytes(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
        try:
            read = read_npz(path, FIELDS)
        except GhptDataError:
            continue
        assert all(np.array_equal(read[name], good[name]) for name in good)  # a time stamp, say


def test_npz_lacking_an_array_and_npz_bomb(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", x=np.ones((2, 3)))
    with pytest.raises(GhptDataError, match="lacks an array"):
        read_npz(tmp_path / "a.npz", FIELDS)
    with (
        zipfile.ZipFile(tmp_path / "b.npz", "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("x.npy", "w", force_zip64=True) as member,
    ):
        np.lib.format.write_array_header_1_0(
            member, {"descr": "<f8", "fortran_order": False, "shape": (1 << 24, 3)}
        )
        for _ in range(24):
            member.write(bytes(1 << 24))
    assert (tmp_path / "b.npz").stat().st_size < 1 << 20
    with pytest.raises(GhptDataError, match=r"b\.npz: x: claims"):
        read_npz(tmp_path / "b.npz", FIELDS)


@pytest.mark.parametrize(
    "text", ["", "{", '{"a": NaN}', "[Infinity]", "[" * 100_000, "9" * 10_000, "\ud800\udfff"]
)
def test_bad_json(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.json").write_bytes(
        text.encode("utf-16" if "\ud800" in text else "utf-8", "surrogatepass")
    )
    with pytest.raises(GhptDataError, match=r"a\.json: is not valid JSON"):
        read_json(tmp_path / "a.json")


def test_good_json(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps({"a": [1.5, None]}))
    assert read_json(tmp_path / "a.json") == {"a": [1.5, None]}
