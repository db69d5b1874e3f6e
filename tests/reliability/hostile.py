"""Hostile files, and a worker that reads them in children with little memory and little time.

``python hostile.py A1 openpose 1000 5`` reads 1,000 mutated files from seed 5 on, in batches, and
prints what happened as JSON. A batch's process that dies, or that Python cannot interrupt, counts
as a crash or a hang of its own.
"""

import io
import json
import os
import pickle
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from damage import _spoilt as spoil_bytes
from ghpt.data.formats.camera_files import read_cameras
from ghpt.data.formats.camera_writers import write_opencv, write_pose2sim
from ghpt.data.formats.key_points import read_key_points
from ghpt.data.formats.skeletons import SKELETONS
from ghpt.data.synthetic.rigs import panoptic_rig
from ghpt.errors import GhptDataError
from single_person import SinglePerson, write_person

SECONDS, BATCH, MEMORY = 1.0, 200, 1 << 30
"""Of the processor for one file; files in a process; bytes that a process may add to those of the
imports.
"""
RNG = np.random.default_rng(0)
BODY = np.column_stack([RNG.uniform(0, 400, (17, 2)).round(2), RNG.uniform(0.1, 1, 17).round(3)])


@dataclass(frozen=True)
class Format:
    """A small whole recording or rig, of which one file is spoilt."""

    write: Callable[[Path], Path]
    """Writes it into a folder and returns the file that is spoilt."""
    read: Callable[[Path], Any]
    """Reads the folder."""
    mutate: Callable[[bytes, random.Random], bytes]
    """Spoils the structure, not the bytes."""


def openpose(folder: Path) -> Path:
    for view in ("a", "b"):
        (folder / view).mkdir()
        for frame in (1, 2):
            people = [{"person_id": [-1], "pose_keypoints_2d": BODY.ravel().tolist()}]
            (folder / view / f"{frame:06d}.json").write_text(
                json.dumps({"version": 1.3, "people": people})
            )
    return folder / "a" / "000001.json"


def mmpose(folder: Path) -> Path:
    people = [{"keypoints": BODY[:, :2].tolist(), "keypoint_scores": BODY[:, 2].tolist()}]
    names = {str(i): name for i, name in enumerate(SKELETONS["coco_17"])}
    frames = [{"frame_id": frame, "instances": people} for frame in (1, 2)]
    for view in ("a", "b"):
        content = {"meta_info": {"keypoint_id2name": names}, "instance_info": frames}
        (folder / f"{view}.json").write_text(json.dumps(content))
    return folder / "a.json"


def coco(folder: Path) -> Path:
    people = [
        {"image_id": f, "category_id": 1, "keypoints": BODY.ravel().tolist(), "score": 0.9}
        for f in (1, 2)
    ]
    for view in ("a", "b"):
        (folder / f"{view}.json").write_text(json.dumps(people))
    return folder / "a.json"


def results(folder: Path) -> Path:
    """MMPose's result dict, a file for each camera."""
    person = {"keypoints": BODY[:, :2].tolist(), "keypoint_scores": BODY[:, 2].tolist()}
    for view in ("a", "b"):
        content = {"visualization": [], "predictions": [[person], [person]]}
        (folder / f"{view}.json").write_text(json.dumps(content))
    return folder / "a.json"


def easymocap(folder: Path) -> Path:
    for view in ("a", "b"):
        (folder / view).mkdir()
        for frame in (1, 2):
            annots = [{"personID": 0, "keypoints": BODY.tolist()}]
            content = {"filename": f"images/{view}/{frame}.jpg", "annots": annots}
            (folder / view / f"{frame:06d}.json").write_text(json.dumps(content))
    return folder / "a" / "000001.json"


def rtmlib(folder: Path) -> Path:
    arrays = {"keypoints": [BODY[:, :2].tolist()], "scores": [BODY[:, 2].tolist()]}
    for view in ("a", "b"):
        frames = [{"frame_id": frame} | arrays for frame in (1, 2)]
        (folder / f"{view}.json").write_text(json.dumps(frames))
    return folder / "a.json"


def yolo(folder: Path) -> Path:
    share = BODY / [400, 400, 1]
    line = "0 " + " ".join(f"{value:.6f}" for value in (0.5, 0.5, 0.2, 0.6, *share.ravel()))
    for view in ("a", "b"):
        (folder / view).mkdir()
        for frame in (1, 2):
            (folder / view / f"{view}_{frame}.txt").write_text(f"{line}\n{line}\n")
    return folder / "a" / "a_1.txt"


def sleap(folder: Path) -> Path:
    import h5py

    for view in ("a", "b"):
        with h5py.File(folder / f"{view}.analysis.h5", "w") as file:
            file["node_names"] = np.array(SKELETONS["coco_17"], "S")
            points = np.broadcast_to(BODY[:, :2].T[None, ..., None], (1, 2, 17, 3))
            file.create_dataset("tracks", data=points, compression="gzip")
            file["point_scores"] = np.broadcast_to(BODY[None, :, 2:], (1, 17, 3))
    return folder / "a.analysis.h5"


def deeplabcut(folder: Path) -> Path:
    import h5py

    names = [("net", name, c) for name in SKELETONS["coco_17"] for c in ("x", "y", "likelihood")]
    rows = np.zeros(3, [("index", "<i8"), ("values_block_0", "<f8", (51,))])
    rows["index"] = np.arange(3)
    rows["values_block_0"] = BODY.ravel()
    for view in ("a", "b"):
        with h5py.File(folder / f"{view}.h5", "w") as file:
            group = file.create_group("df_with_missing")
            group.attrs["pandas_type"] = np.bytes_(b"frame_table")
            group["table"] = rows
            kind = np.void(pickle.dumps(names, 0))
            group["table"].attrs["values_block_0_kind"] = kind
    return folder / "a.h5"


def sleap_labels(folder: Path) -> Path:
    import h5py

    nodes = [{"id": k} for k in range(17)]
    names = [{"name": name} for name in SKELETONS["coco_17"]]
    text = json.dumps({"nodes": names, "skeletons": [{"nodes": nodes}]})
    whole = ("instance_id", "frame_id", "frame_idx", "video", "from_predicted", "track")
    rows = np.zeros(3, [(name, "<i8") for name in (*whole, "point_id_start", "point_id_end")])
    rows["instance_id"] = rows["frame_id"] = rows["frame_idx"] = np.arange(3)
    rows["from_predicted"] = rows["track"] = -1
    rows["point_id_start"] = np.arange(3) * 17
    rows["point_id_end"] = rows["point_id_start"] + 17
    points = np.zeros(51, [("x", "<f8"), ("y", "<f8"), ("score", "<f8"), ("visible", "?")])
    points["x"], points["y"], points["score"] = np.tile(BODY.T, 3)
    points["visible"] = True
    instances = np.zeros(3, [*rows.dtype.descr, ("instance_type", "u1")])
    for name in rows.dtype.names or ():
        instances[name] = rows[name]
    instances["instance_type"] = 1
    for view in ("a", "b"):
        with h5py.File(folder / f"{view}.slp", "w") as file:
            file.create_group("metadata").attrs["json"] = np.bytes_(text.encode())
            file["frames"] = rows
            file["instances"] = instances
            file["points"] = points
            file["pred_points"] = points
    return folder / "a.slp"


def deeplabcut_csv(folder: Path) -> Path:
    names = SKELETONS["coco_17"]
    head = ["scorer" + ",net" * 51, "bodyparts" + "".join(f",{name}" * 3 for name in names)]
    head.append("coords" + ",x,y,likelihood" * 17)
    rows = [",".join([str(t), *map(str, BODY.ravel().tolist())]) for t in range(3)]
    for view in ("a", "b"):
        (folder / f"{view}.csv").write_text("\n".join([*head, *rows]) + "\n", "utf-8")
    return folder / "a.csv"


def sleap_csv(folder: Path) -> Path:
    names = [f"{name}.{of}" for name in SKELETONS["coco_17"] for of in ("x", "y", "score")]
    head = ",".join(["track", "frame_idx", "instance.score", *names])
    rows = [f"who,{t},0.5,{','.join(map(str, BODY.ravel().tolist()))}" for t in range(3)]
    for view in ("a", "b"):
        (folder / f"{view}.csv").write_text("\n".join([head, *rows]) + "\n", "utf-8")
    return folder / "a.csv"


def caliscope(folder: Path) -> Path:
    rows = [
        f"{t},{port},{t},0.5,{k},{x},{y},,"
        for t in (0, 1)
        for port in (0, 1)
        for k, (x, y, _) in enumerate(BODY)
    ]
    head = "sync_index,port,frame_index,frame_time,point_id,img_loc_x,img_loc_y,obj_loc_x,obj_loc_y"
    (folder / "xy.csv").write_text("\n".join([head, *rows]) + "\n")
    return folder / "xy.csv"


def own_points() -> SinglePerson:
    """Ours: 3 frames, 2 views."""
    points = np.broadcast_to(BODY[:, :2], (3, 2, 17, 2)) + 0.25
    sure = np.broadcast_to(BODY[:, 2], (3, 2, 17)).copy()
    return SinglePerson(
        "", ("a", "b"), SKELETONS["coco_17"], np.arange(3), points, sure, sure > 0, 60.0
    )


def npz(folder: Path) -> Path:
    write_person(folder / "points.npz", own_points())
    return folder / "points.npz"


def npy(folder: Path) -> Path:
    crop = np.broadcast_to(BODY[:, :2], (2, 2, 17, 2)).astype(np.float32)
    np.save(
        folder / "all_bboxes.npy",
        np.broadcast_to(np.array([[0, 0], [500, 500]], np.float32), (2, 2, 2, 2)),
    )
    np.save(folder / "all_2d_preds.npy", crop)
    return folder / "all_2d_preds.npy"


def freemocap(folder: Path) -> Path:
    points = np.concatenate([BODY[:, :2], BODY[:16, :2]])
    array = np.broadcast_to(points, (2, 3, 33, 2)).astype(np.float32)
    np.save(folder / "mediapipe_2dData_pixelXY.npy", array)
    return folder / "mediapipe_2dData_pixelXY.npy"


def toml(folder: Path) -> Path:
    write_pose2sim(folder / "rig.toml", panoptic_rig((1, 2)), {"adjusted": False})
    return folder / "rig.toml"


def yaml(folder: Path) -> Path:
    write_opencv(folder, panoptic_rig((1, 2)))
    return folder / "intri.yml"


def panoptic(folder: Path) -> Path:
    rig = panoptic_rig((1, 2))
    cameras = [
        {
            "name": name,
            "type": "hd",
            "resolution": rig.size[v].tolist(),
            "K": rig.cameras.K[v].tolist(),
            "distCoef": rig.distortion[v].tolist(),
            "R": rig.cameras.R[v].tolist(),
            "t": rig.cameras.t[v].tolist(),
        }
        for v, name in enumerate(rig.names)
    ]
    (folder / "calibration.json").write_text(json.dumps({"cameras": cameras}))
    return folder / "calibration.json"


def fields(view: int) -> dict[str, Any]:
    rig = panoptic_rig((1, 2))
    return {
        "intrinsicMat": rig.cameras.K[view].numpy(),
        "distortion": rig.distortion[view].numpy(),
        "imageSize": np.array([[1080.0], [1920.0]]),
        "rotation": rig.cameras.R[view].numpy(),
        "translation": rig.cameras.t[view].numpy()[:, None],
    }


def opencap(folder: Path) -> Path:
    for view in (1, 0):
        path = folder / f"{view}.pickle"
        path.write_bytes(pickle.dumps(fields(view)))
    return path


def camera_json(folder: Path) -> Path:
    for view in (1, 0):
        path = folder / f"{view}.json"
        values = {name: value.tolist() for name, value in fields(view).items()}
        path.write_text(json.dumps({"convention": "opencv", "world2cam": True} | values))
    return path


def camera_list(folder: Path) -> Path:
    """Of intrinsics that are single numbers, with a quaternion and the camera in the world."""
    cameras = []
    for view in (0, 1):
        K = fields(view)["intrinsicMat"]
        numbers = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
        pose = np.linalg.inv(np.vstack([np.eye(3, 4, k=0), [0, 0, 0, 1]]) + view * np.eye(4, k=3))
        rotation = [{"c2w": pose.tolist()}, {"qvec": [1, 0, 0, 0], "t": [1, 2, 3]}][view]
        cameras.append({"name": f"cam{view}", "distortion_model": "plumb_bob"} | numbers | rotation)
    (folder / "rig.json").write_text(json.dumps(cameras))
    return folder / "rig.json"


def camera_yml(folder: Path) -> Path:
    for view in (1, 0):
        path = folder / f"{view}.yml"
        values = {name: np.atleast_2d(value) for name, value in fields(view).items()}
        values.pop("imageSize")
        lines = []
        for name, value in values.items():
            numbers = value.ravel().tolist()
            lines.append(f"{name}: {{rows: {len(value)}, cols: {value.shape[1]}, data: {numbers}}}")
        path.write_text("%YAML:1.0\n---\nimage_width: 1920\n" + "\n".join(lines) + "\n")
    return path


def human36m(folder: Path) -> Path:
    rig = panoptic_rig((1, 2))
    intrinsics = {
        name: {
            "calibration_matrix": rig.cameras.K[v].tolist(),
            "distortion": rig.distortion[v].tolist(),
        }
        for v, name in enumerate(rig.names)
    }
    poses = {
        name: {"R": rig.cameras.R[v].tolist(), "t": rig.cameras.t[v].tolist()}
        for v, name in enumerate(rig.names)
    }
    (folder / "cameras.json").write_text(
        json.dumps({"intrinsics": intrinsics, "extrinsics": {"S1": poses}})
    )
    return folder / "cameras.json"


def colmap(folder: Path) -> Path:
    import pycolmap

    scene = pycolmap.Reconstruction()
    for number in (1, 2):
        scene.add_camera_with_trivial_rig(
            pycolmap.Camera(
                model="OPENCV",
                width=640,
                height=480,
                params=[500, 500, 320, 240, 0, 0, 0, 0],
                camera_id=number,
            )
        )
        image = pycolmap.Image(name=f"cam{number}.png", camera_id=number, image_id=number)
        image.points2D = [pycolmap.Point2D(np.array([3.0, 4.0]))] * 2
        scene.add_image_with_trivial_frame(
            image, pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([number, 0.0, 5.0]))
        )
    scene.write_binary(folder)
    return folder / "images.bin"


HOSTILE = (
    None,
    True,
    -1,
    0,
    1.5,
    1e308,
    -1e308,
    10**400,
    "",
    "x",
    "nan",
    [],
    {},
    [[]],
    [None] * 3,
    "\u0000",
    "é" * 300,
)


def mutate_json(data: bytes, chance: random.Random) -> bytes:
    content = json.loads(data)
    for _ in range(chance.choice((1, 1, 1, 2, 4))):
        parent, key = _place(content, chance)
        if parent is None:
            content = chance.choice(HOSTILE)
            break
        kind = chance.choice(("drop", "hostile", "hostile", "twice", "short", "constant"))
        if kind == "drop":
            del parent[key]
        elif kind == "twice" and isinstance(parent, list):
            parent.insert(key, parent[key])
        elif kind == "short" and isinstance(parent[key], list):
            parent[key] = parent[key][: chance.randrange(len(parent[key]) + 1)]
        elif kind == "constant":
            parent[key] = chance.choice((float("nan"), float("inf"), -float("inf")))
        else:
            parent[key] = chance.choice(HOSTILE)
    sys.set_int_max_str_digits(0)
    text = json.dumps(content)
    sys.set_int_max_str_digits(4300)
    if chance.random() < 0.1:  # a key twice
        text = text.replace("{", '{"people": 1, "cameras": 2, "instance_info": 3, ', 1)
    return text.encode()


def _place(content: Any, chance: random.Random) -> tuple[Any, Any]:
    parent, key = None, None
    while isinstance(content, dict | list) and content and chance.random() < 0.8:
        parent, key = (
            content,
            chance.choice(list(content) if isinstance(content, dict) else range(len(content))),
        )
        content = parent[key]
    return parent, key


TOKENS = (
    "nan",
    "-nan",
    "inf",
    "1e308",
    "-1",
    "1e400",
    "[]",
    "{}",
    '""',
    "true",
    "null",
    "~",
    "!!python/object:x",
    "&a",
    "*a",
    "${oc.env:HOME}",
    "[[1, 2], [3]]",
    "2026-01-01",
    "é",
    "\t",
    "0x",
    "'",
    "[" * 500,
    "9" * 5000,
)


def mutate_text(data: bytes, chance: random.Random) -> bytes:
    """Lines or numbers dropped, doubled, exchanged, or replaced by what does not belong there."""
    lines = data.decode().splitlines(keepends=True)
    place = chance.randrange(len(lines))
    kind = chance.choice(("drop", "twice", "swap", "token", "token", "token"))
    if kind == "drop":
        del lines[place]
    elif kind == "twice":
        lines.insert(place, lines[place])
    elif kind == "swap":
        other = chance.randrange(len(lines))
        lines[place], lines[other] = lines[other], lines[place]
    else:
        words = lines[place].replace(",", " , ").replace("[", " [ ").replace("]", " ] ").split(" ")
        words[chance.randrange(len(words))] = chance.choice(TOKENS)
        lines[place] = " ".join(words).rstrip("\n") + "\n"
    return "".join(lines).encode()


def mutate_array(array: np.ndarray, chance: random.Random) -> np.ndarray:
    kind = chance.choice(("type", "shape", "value", "empty", "object", "more"))
    if kind == "type" and array.dtype.kind in "fiub":
        with np.errstate(all="ignore"):
            return array.astype(chance.choice(("i8", "U3", "?", "c16", "S4", ">f2", "f8")))
    if kind == "shape":
        return array.reshape(-1) if array.ndim > 1 else array.reshape(1, -1)
    if kind == "value" and array.size and array.dtype.kind == "f":
        array = array.copy()
        value = np.array(chance.choice((np.nan, np.inf, -3e38, 1e7)), array.dtype)
        array.reshape(-1)[chance.randrange(array.size)] = value
        return array
    if kind == "empty":
        return array[:0] if array.ndim else np.zeros(0)
    if kind == "object":
        return np.array([None, {}], object)
    return np.concatenate([array, array]) if array.ndim else np.array(-1.0)


def mutate_npy(data: bytes, chance: random.Random) -> bytes:
    out = io.BytesIO()
    np.save(out, mutate_array(np.load(io.BytesIO(data)), chance), allow_pickle=True)
    return out.getvalue()


def mutate_npz(data: bytes, chance: random.Random) -> bytes:
    with np.load(io.BytesIO(data)) as stored:
        arrays = {
            name: stored[name]
            for name in stored.files
            if name != "members" or chance.random() < 0.1
        }
    name = chance.choice(list(arrays))
    if chance.random() < 0.2:
        del arrays[name]
    else:
        arrays[name] = mutate_array(arrays[name], chance)
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()


def mutate_records(data: bytes, chance: random.Random) -> bytes:
    """Fields of 4 or 8 bytes replaced by extreme ones."""
    spoilt = bytearray(data)
    place = chance.randrange(0, len(spoilt) - 8)
    value = chance.choice(
        (b"\xff" * 8, b"\x00" * 8, b"\x00" * 6 + b"\xf0\x7f", b"\x00" * 7 + b"\x80", b"\xff" * 4)
    )
    spoilt[place : place + len(value)] = value
    return bytes(spoilt)


FORMATS: dict[str, Format] = {
    "openpose": Format(openpose, lambda folder: read_key_points(folder, "coco_17"), mutate_json),
    "mmpose": Format(mmpose, read_key_points, mutate_json),
    "coco": Format(coco, read_key_points, mutate_json),
    "results": Format(results, lambda folder: read_key_points(folder, "coco_17"), mutate_json),
    "easymocap": Format(easymocap, lambda folder: read_key_points(folder, "coco_17"), mutate_json),
    "rtmlib": Format(rtmlib, lambda folder: read_key_points(folder, "coco_17"), mutate_json),
    "yolo": Format(yolo, read_key_points, mutate_text),
    "sleap": Format(sleap, read_key_points, mutate_records),
    "deeplabcut": Format(deeplabcut, read_key_points, mutate_records),
    "sleap_labels": Format(sleap_labels, read_key_points, mutate_records),
    "deeplabcut_csv": Format(deeplabcut_csv, read_key_points, mutate_text),
    "sleap_csv": Format(sleap_csv, read_key_points, mutate_text),
    "caliscope": Format(
        caliscope, lambda folder: read_key_points(folder / "xy.csv", "coco_17"), mutate_text
    ),
    "npz": Format(npz, lambda folder: read_key_points(folder / "points.npz"), mutate_npz),
    "freemocap": Format(freemocap, read_key_points, mutate_npy),
    "npy": Format(npy, read_key_points, mutate_npy),
    "toml": Format(toml, lambda folder: read_cameras(folder / "rig.toml"), mutate_text),
    "yaml": Format(yaml, read_cameras, mutate_text),
    "panoptic": Format(
        panoptic, lambda folder: read_cameras(folder / "calibration.json"), mutate_json
    ),
    "opencap": Format(opencap, read_cameras, mutate_records),
    "camera_json": Format(camera_json, read_cameras, mutate_json),
    "camera_list": Format(camera_list, read_cameras, mutate_json),
    "camera_yml": Format(camera_yml, read_cameras, mutate_text),
    "human36m": Format(human36m, lambda folder: read_cameras(folder / "cameras.json"), mutate_json),
    "colmap": Format(colmap, lambda folder: read_cameras(folder, unit_mm=1), mutate_records),
}


def values(found: Any) -> dict[str, Any]:
    """What was read, without where from."""
    held = {name: value for name, value in vars(found).items() if name not in ("path", "format")}
    points = held.pop("points", None)
    if points is None:
        return held
    own = {"key_points": points.pixels, "confidence": points.confidence, "valid": points.valid}
    return held | own


def same(a: Any, b: Any) -> bool:
    """Whether two readings hold the same values."""
    one, other = values(a), values(b)
    return all(np.array_equal(np.asarray(one[name]), np.asarray(other[name])) for name in one)


def part_of(found: Any, whole: Any) -> bool:
    """Whether a reading holds nothing but values of the whole's: fewer frames at the end, or
    cameras without poses.
    """
    one, other = values(found), values(whole)
    if "K" in one:
        return all(
            one[name] is None or np.array_equal(one[name], other[name])
            for name in one
            if name not in ("unit_known", "unposed")
        )
    if not {*one["views"]} <= {*other["views"]} or one["joints"] != other["joints"]:
        return False
    rows, views = len(one["row"]), [other["views"].index(view) for view in one["views"]]
    kept = np.isin(other["view"], views) & np.isin(other["frame"][other["row"]], one["frame"])
    at = np.flatnonzero(kept)
    valid = one["valid"]
    return rows <= len(at) and all(
        np.array_equal(one[name][valid], other[name][at[:rows]][valid])
        for name in ("key_points", "confidence")
    )


def spoilt(row: str, whole: bytes, form: Format, numbers: Sequence[int]) -> Iterator[bytes]:
    """The files of a row: A1 mutates structure and bytes by turns, A2 bytes alone, A3 cuts the file
    at the bytes of these numbers.
    """
    for number in numbers:
        chance = random.Random(number)
        if row == "A3":
            yield whole[:number]
        elif row == "A1" and number % 2:
            yield form.mutate(whole, chance)
        else:
            yield spoil_bytes(whole, chance)


class Late(Exception):
    """A file took longer than SECONDS."""


def late(*_: Any) -> None:
    raise Late


def batch(
    row: str, form: Format, numbers: Sequence[int], folder: Path, target: Path
) -> dict[str, Any]:
    """Reads one file after the other; what each gave, and by how much the memory grew."""
    whole, reference, outcomes, notes = target.read_bytes(), form.read(folder), Counter(), []
    signal.signal(signal.SIGPROF, late)
    held = (
        int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[0])
        * resource.getpagesize()
    )
    resource.setrlimit(resource.RLIMIT_AS, (held + MEMORY, held + MEMORY))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for number, data in zip(numbers, spoilt(row, whole, form, numbers), strict=True):
        target.write_bytes(data)
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        try:
            found = form.read(folder)
            outcome = (
                "same"
                if same(found, reference)
                else "part"
                if part_of(found, reference)
                else "different"
            )
        except GhptDataError:
            outcome = "named"
        except Late:
            outcome = "hang"
        except BaseException as error:
            outcome = "leak"
            notes.append(f"{number}: {type(error).__name__}: {error}"[:300])
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
        outcomes[outcome] += 1
        if outcome == "hang" or (outcome == "different" and row != "A1" and len(notes) < 20):
            notes.append(f"{number}: {outcome}")
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    return {"outcomes": outcomes, "notes": notes, "grown_kib": grown}


def forked(run: Callable[[], dict[str, Any]], seconds: float) -> dict[str, Any]:
    """What ``run`` returns in a child; a crash or a hang if it returns nothing."""
    with tempfile.TemporaryFile() as answer:
        if (child := os.fork()) == 0:
            status = 1
            try:
                answer.write(json.dumps(run()).encode())
                answer.flush()
                status = 0
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(status)
        end = time.monotonic() + seconds
        while (ended := os.waitpid(child, os.WNOHANG))[0] == 0:
            if time.monotonic() > end:
                os.kill(child, signal.SIGKILL)
                os.waitpid(child, 0)
                return {"outcomes": {"hang": 1}, "notes": ["not interruptible"], "grown_kib": 0}
            time.sleep(0.002)
        answer.seek(0)
        if ended[1] != 0:
            return {"outcomes": {"crash": 1}, "notes": [f"status {ended[1]}"], "grown_kib": 0}
        return json.load(answer)


def cuts(size: int, count: int, seed: int) -> Sequence[int]:
    """So many places of a file, or all that it has, the last 50 among them."""
    if count >= size:
        return range(size)
    last = max(size - 50, 0)
    return [*sorted(random.Random(seed).sample(range(last), count - 50)), *range(last, size)]


def main(row: str, name: str, count: int, seed: int) -> dict[str, Any]:
    """All files of a format, in batches."""
    form, outcomes, notes, grown = FORMATS[name], Counter(), [], 0
    with tempfile.TemporaryDirectory() as root:
        folder = Path(root) / "data"
        folder.mkdir()
        target = form.write(folder)
        whole = target.read_bytes()
        chosen = cuts(len(whole), count, seed) if row == "A3" else range(seed, seed + count)
        for start in range(0, len(chosen), BATCH):
            numbers = chosen[start : start + BATCH]
            found = forked(
                lambda numbers=numbers: batch(row, form, numbers, folder, target),
                10 + SECONDS * BATCH / 4,
            )
            target.write_bytes(whole)
            outcomes.update(found["outcomes"])
            notes += found["notes"]
            grown = max(grown, found["grown_kib"])
    return {
        "outcomes": outcomes,
        "notes": notes,
        "grown_kib": grown,
        "file_kib": len(whole) / 1024,
        "total": len(chosen),
    }


if __name__ == "__main__":
    import warnings

    warnings.simplefilter("error")
    row, names, count, seed = (
        sys.argv[1],
        sys.argv[2].split(","),
        int(sys.argv[3]),
        int(sys.argv[4]),
    )
    started = {}
    for name in names:
        clock = time.monotonic()
        started[name] = main(row, name, count, seed) | {"seconds": time.monotonic() - clock}
    print(json.dumps(started))
