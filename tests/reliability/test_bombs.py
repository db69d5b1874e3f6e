"""A4: small files that ask for much memory or time are refused in a second and 256 MiB.

All are read in one child of its own process, forked for each bomb (``hostile.forked``).
"""

import json
import pickle
import resource
import shutil
import struct
import sys
import time
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import children

sys.path.insert(0, str(Path(__file__).resolve().parent))

from hostile import forked

from ghpt.data.datasets.labels import read_labels
from ghpt.data.formats.camera_files import read_cameras
from ghpt.data.formats.key_points import read_key_points
from ghpt.data.people.stored import open_stored
from ghpt.errors import GhptDataError

SECONDS, MEBIBYTES = 1.0, 256
"""Of the processor, and of memory."""


def npy_header(shape: tuple[int, ...], dtype: str = "<f8") -> bytes:
    text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text) + 1) + text.encode() + b"\n"


def archive(path: Path, name: str, packed: bytes, size: int, members: int = 1) -> None:
    """A zip whose entries all claim to be this packed member, wherever they say it is."""
    local = (
        struct.pack("<4s5H3I2H", b"PK\x03\x04", 20, 0, 8, 0, 33, 0, len(packed), size, len(name), 0)
        + name.encode()
    )
    names = [name, *(f"{name[:-4]}{i}.npy" for i in range(1, members))]
    listed = b"".join(
        struct.pack(
            "<4s6H3I5H2I",
            b"PK\x01\x02",
            20,
            20,
            0,
            8,
            0,
            33,
            0,
            len(packed),
            size,
            len(n),
            0,
            0,
            0,
            0,
            0,
            0,
        )
        + n.encode()
        for n in names
    )
    start = len(local) + len(packed)
    end = struct.pack(
        "<4s4H2IH",
        b"PK\x05\x06",
        0,
        0,
        min(members, 65535),
        min(members, 65535),
        len(listed),
        start,
        0,
    )
    path.write_bytes(local + packed + listed + end)


def zeros(mebibytes: int) -> bytes:
    """So many MiB of zeros, packed, after an npy header of 4-dimensional key points that they
    fill."""
    frames = (mebibytes << 20) // (2 * 17 * 2 * 8)
    header = npy_header((frames, 2, 17, 2))
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    first = packer.compress(header) + packer.flush(zlib.Z_FULL_FLUSH)
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    block = packer.compress(bytes(1 << 20)) + packer.flush(zlib.Z_FULL_FLUSH)
    return first + block * mebibytes + b"\x03\x00"


def npz_2gib(path: Path) -> None:
    archive(path, "key_points.npy", zeros(2047), 2047 << 20)


def npz_1e12(path: Path) -> None:
    content = npy_header((10**12, 2, 17, 2))
    packed = zlib.compress(content)[2:-4]
    archive(path, "key_points.npy", packed, len(content))


def npz_1e5_members(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as handle:
        for number in range(100_000):
            handle.writestr(f"{number}.npy", b"")


def npz_overlapping(path: Path) -> None:
    archive(path, "key_points.npy", zeros(64), 64 << 20, members=500)


def yaml_laughs(path: Path) -> None:
    lines = ["%YAML:1.0", "---", "a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 10)]
    path.write_text(
        "\n".join([*lines, "names: *a9", "K_x: {rows: 3, cols: 3, data: *a9}"]) + "\n",
        encoding="utf-8",
    )


def sparse(path: Path, start: bytes, size: int, end: bytes = b"") -> None:
    with open(path, "wb") as handle:
        handle.write(start)
        handle.truncate(size)
        handle.seek(0, 2)
        handle.write(end)


MATRIX = "[[9, 0, 6], [0, 9, 3], [0, 0, 1]]"


def repeated(start: str, one: str, times: int, end: str) -> Callable[[Path], None]:
    """A text with ``one`` so many times in it."""
    return lambda path: path.write_text(start + one * times + end)


def numbered(start: str, one: str, times: int) -> Callable[[Path], None]:
    """A text with ``one`` for each number."""
    return lambda path: path.write_text(start + "".join(one.format(i) for i in range(times)))


def openpose(one: str, times: int) -> Callable[[Path], None]:
    """A folder with a camera's folder, whose only file has so many people."""

    def write(path: Path) -> None:
        (path / "a").mkdir(parents=True)
        repeated('{"people": [', f"{one},", times, f"{one}]}}")(path / "a" / "1.json")

    return write


def label_of_a_line(path: Path) -> None:
    (path / "a").mkdir(parents=True)
    sparse(path / "a" / "1.txt", b"0" + b" 0.5" * 2000, 1 << 30, b"\n")


def many_views(path: Path, save: Callable[..., None] = np.savez) -> None:
    points = np.ones((2, 100_000, 2, 2), np.float32)
    save(path, key_points=points, views=np.array(["x"] * 100_000), joints=np.array(["a", "b"]))


def authors_of_many_views(path: Path) -> None:
    path.mkdir()
    np.save(path / "all_2d_preds.npy", np.ones((2, 100_000, 17, 2), np.float32))
    np.save(path / "all_bboxes.npy", np.ones((2, 100_000, 2, 2), np.float32))


def colmap_of_many_images(path: Path) -> None:
    path.mkdir()
    numbered("", "{0} PINHOLE 640 480 500 500 320 240\n", 1)(path / "cameras.txt")
    numbered("", "{0} 1 0 0 0 0 0 {0} 0 x{0}.png\n\n", 300_000)(path / "images.txt")


def labels_1e9(path: Path) -> None:
    descr = "[" + ", ".join(f"('x{i}', '<f4', (1000000000,))" for i in range(2)) + "]"
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': (), }}"
    path.write_bytes(
        b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text) + 1) + text.encode() + b"\n" + bytes(100)
    )


def written(text: str | bytes) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(text.encode() if isinstance(text, str) else text)


Bomb = tuple[str, Callable[[Path], Any], Callable[[Path], Any]]
DEEP, LONG = "[" * 200_000, "9" * 2_000_000
PICKLED = pickle.dumps({"intrinsicMat": np.zeros(3)}, 2)
"""With the shape (3,) as the bytes K 3 of a tuple of one."""
CALISCOPE = b"sync_index,port,point_id,img_loc_x,img_loc_y\n"
OF_COCO = '[{"image_id": 1, "keypoints": ['
BOMBS: dict[str, Bomb] = {
    "npz of 2 GiB of zeros": ("p.npz", npz_2gib, read_key_points),
    "npz that declares 1e12 elements": ("p.npz", npz_1e12, read_key_points),
    "npz of 1e5 members": ("p.npz", npz_1e5_members, read_key_points),
    "npz of overlapping members": ("p.npz", npz_overlapping, read_key_points),
    "npy with a header of 4 GiB": (
        "all_2d_preds.npy",
        written(b"\x93NUMPY\x02\x00\xff\xff\xff\xff" + b" " * 100),
        read_key_points,
    ),
    "npy of 1e12 elements": (
        "all_2d_preds.npy",
        written(npy_header((10**12, 4, 17, 2), "<f4")),
        read_key_points,
    ),
    "COCO of depth 2e5": ("a.json", written(OF_COCO + DEEP), read_key_points),
    "COCO with an integer of 2e6 digits": (
        "a.json",
        written(OF_COCO + LONG + "]}]"),
        read_key_points,
    ),
    "COCO with a frame number of 4,000 digits": (
        "a.json",
        written('[{"image_id": ' + LONG[:4000] + "}]"),
        read_key_points,
    ),
    "MMPose of depth 2e5": ("a.json", written('{"instance_info": ' + DEEP), read_key_points),
    "results of depth 2e5": ("a.json", written('{"predictions": ' + DEEP), read_key_points),
    "rtmlib of depth 900": (
        "a.json",
        written('{"keypoints": ' + "[" * 900 + "]" * 900 + ', "scores": []}'),
        read_key_points,
    ),
    "label of 1 GB in a line": (
        "labels",
        label_of_a_line,
        read_key_points,
    ),
    "freemocap of 1e12 elements": (
        "mediapipe_2dData_pixelXY.npy",
        written(npy_header((10**6, 10**6, 33, 2), "<f4")),
        read_key_points,
    ),
    "JSON of 1 GB in a line": (
        "a.json",
        lambda path: sparse(path, b'[{"image_id": 1, "x": "', 1 << 30),
        read_key_points,
    ),
    "CSV of 1 GB in a line": (
        "xy.csv",
        lambda path: sparse(path, CALISCOPE, 1 << 30, b"\n"),
        read_key_points,
    ),
    "cameras JSON of depth 2e5": ("c.json", written('{"cameras": ' + DEEP), read_cameras),
    "cameras JSON with an integer of 2e6 digits": (
        "c.json",
        written('{"cameras": ' + LONG + "}"),
        read_cameras,
    ),
    "cameras JSON of 1 GB": (
        "c.json",
        lambda path: sparse(path, b'{"cameras": "', 1 << 30),
        read_cameras,
    ),
    "YAML that laughs": ("intri.yml", yaml_laughs, read_cameras),
    "YAML of depth 5e3": (
        "intri.yml",
        written("%YAML:1.0\nnames: " + "[" * 5000 + "]" * 5000 + "\n"),
        read_cameras,
    ),
    "YAML of 1 GB": ("intri.yml", lambda path: sparse(path, b"%YAML:1.0\n", 1 << 30), read_cameras),
    "TOML of depth 5e3": ("c.toml", written("a = " + "[" * 5000 + "]" * 5000), read_cameras),
    "TOML with a key of 1e5 parts": ("c.toml", written("a." * 100_000 + "a = 1"), read_cameras),
    "TOML with an integer of 2e6 digits": ("c.toml", written(f"a = {LONG}"), read_cameras),
    "TOML of 1 GB": ("c.toml", lambda path: sparse(path, b"a = 1\n", 1 << 30), read_cameras),
    "OpenPose of 200,000 people": (
        "o",
        openpose('{"pose_keypoints_2d": [1, 2, 1]}', 200_000),
        read_key_points,
    ),
    "OpenPose of as many people as a file may hold": ("o", openpose("{}", 24_000), read_key_points),
    "COCO of 20 million lists": (
        "a.json",
        repeated("[", "[],", 20_000_000, "[]]"),
        read_key_points,
    ),
    "COCO of 20 million objects": (
        "a.json",
        repeated("[", "{},", 20_000_000, "{}]"),
        read_key_points,
    ),
    "COCO of 30 million numbers": (
        "a.json",
        repeated(OF_COCO, "0,", 30_000_000, "0]}]"),
        read_key_points,
    ),
    "MMPose of 700,000 people": (
        "a.json",
        repeated(
            '{"instance_info": [{"frame_id": 1, "instances": [',
            '{"keypoints": [[1, 2]], "keypoint_scores": [1]},',
            700_000,
            "{}]}]}",
        ),
        read_key_points,
    ),
    "Panoptic of 200,000 cameras": (
        "c.json",
        repeated(
            '{"cameras": [',
            f'{{"name": "a", "K": {MATRIX}, "distCoef": [0, 0, 0, 0, 0]}},',
            200_000,
            "{}]}",
        ),
        read_cameras,
    ),
    "Panoptic of as many lists as a file may hold": (
        "c.json",
        repeated('{"cameras": [', "[],", 90_000, "[]]}"),
        read_cameras,
    ),
    "TOML of 8,000 cameras": (
        "c.toml",
        numbered("", f"[c{{0}}]\nmatrix = {MATRIX}\ndistortions = [0, 0, 0, 0]\n", 8000),
        read_cameras,
    ),
    "TOML of as many tables as a file may hold": (
        "c.toml",
        numbered("", "[c{0}]\n", 9_900),
        read_cameras,
    ),
    "YAML of 80,000 names": (
        "intri.yml",
        repeated("%YAML:1.0\n---\nnames: [", "a, ", 80_000, "a]\n"),
        read_cameras,
    ),
    "YAML of 3,500 matrices": (
        "intri.yml",
        numbered(
            "%YAML:1.0\n---\n",
            "K_{0}: {{rows: 3, cols: 3, dt: d, data: [1,0,0,0,1,0,0,0,1]}}\n",
            3500,
        ),
        read_cameras,
    ),
    "YAML of depth 2e5 by indentation": (
        "intri.yml",
        repeated("%YAML:1.0\n---\nnames:\n  ", "- ", 200_000, "a\n"),
        read_cameras,
    ),
    "npz of 1e5 views": ("p.npz", many_views, read_key_points),
    "npz of 1e5 views, in parts": ("p.npz", many_views, lambda path: open_stored(path, None, None)),
    "authors' npy of 1e5 views": ("o", authors_of_many_views, read_key_points),
    "COLMAP of 3e5 images": (
        "o",
        colmap_of_many_images,
        lambda path: read_cameras(path, unit_mm=1),
    ),
    "a pickled camera of 1e9 elements": (
        "c.pickle",
        written(PICKLED.replace(b"K\x03\x85", b"J\x00\xca\x9a\x3b\x85")),
        read_cameras,
    ),
    "a pickled camera of 1 GB": (
        "c.pickle",
        lambda path: sparse(path, b"\x80\x04", 1 << 30),
        read_cameras,
    ),
    "labels with a dtype of 1e9 elements": ("labels.npy", labels_1e9, read_labels),
    "labels that declare 1e12 elements": (
        "labels.npy",
        written(npy_header((10**12,), "|O") + b"\x80\x04N."),
        read_labels,
    ),
}


def tried(path: Path, read: Callable[[Path], Any]) -> dict[str, Any]:
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    try:
        read(path)
        outcome = "accepted"
    except GhptDataError:
        outcome = "named"
    except BaseException as error:
        outcome = f"{type(error).__name__}: {error}"[:200]
    seconds = time.process_time() - start
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    return {"outcomes": {outcome: 1}, "notes": [seconds, grown], "grown_kib": 0}


def is_refused(run: dict[str, Any]) -> bool:
    """Whether a bomb was named as one, within the limits."""
    if run["outcomes"] != {"named": 1}:
        return False
    seconds, mebibytes = run["notes"]
    return seconds <= SECONDS and mebibytes <= MEBIBYTES


def main(folder: Path) -> dict[str, Any]:
    found = {}
    for number, (name, (file, write, read)) in enumerate(BOMBS.items()):
        path = folder / str(number) / file
        path.parent.mkdir()
        write(path)
        for _ in range(3):  # what else the machine does is not the reader's doing
            found[name] = forked(lambda path=path, read=read: tried(path, read), 60)
            if is_refused(found[name]):
                break
        shutil.rmtree(path.parent)
    return found


def test_bombs_are_refused(tmp_path, record_row):
    found = json.loads(children.output_of(__file__, tmp_path))
    bad = {name: run for name, run in found.items() if not is_refused(run)}
    slowest, largest = (
        max(run["notes"][i] for run in found.values() if len(run["notes"]) == 2) for i in (0, 1)
    )
    record_row(
        "A4",
        f"bombs refused, at most {slowest:.2f} s and {largest:.0f} MiB",
        len(found) - len(bad),
        len(found),
    )
    assert len(found) == len(BOMBS)
    assert not bad


if __name__ == "__main__":
    print(json.dumps(main(Path(sys.argv[1]))))
