"""Rigs far from their world's zero, as in national grids: every file keeps 0.01 mm."""

import base64
import json
import re
import sys
import zipfile
import zlib
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch

from ghpt.calibration.millimetres import RigScale
from ghpt.commands.predict import predict
from ghpt.data.formats.camera_files import read_cameras
from ghpt.data.formats.camera_writers import write_aniposelib, write_opencv, write_pose2sim
from ghpt.data.formats.stored_npz import add_member
from ghpt.data.people.sequence import KeyPointArrays, Sequence
from ghpt.data.points import KeyPoints
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.errors import GhptDataError
from ghpt.export import WRITERS, Evidence, Scene, read_reconstruction
from ghpt.geometry.cameras import CameraSet
from ghpt.observations import Recording
from ghpt.report.calibration import CalibrationResult
from ghpt.report.rig_files import write_poses
from ghpt.skeleton import MIRROR
from predicting import config, numbers_of, walk
from reconstructions import about, in_parts, random_reconstruction
from test_predict import PIXELS, checkpoint, points_file

pytestmark = pytest.mark.usefixtures("blank_figures")

FRAMES = 6
METRE = 1000.0
"""mm."""
OFFSETS = {
    "at the zero": (0.0, 0.0, 0.0),
    "10 km": (1e4 * METRE, 0.0, 0.0),
    "UTM": (500_321.4 * METRE, 5_412_345.6 * METRE, 312.7 * METRE),
    "10,000 km": (1e7 * METRE, -1e7 * METRE, 1e7 * METRE),
}
LIMIT = 0.01
"""mm, of what a distance may cost."""


def moved_rig(offset) -> CameraSet:
    rig = human36m_rig("S9")
    cameras = rig.cameras.relative_to(-torch.tensor(offset, dtype=torch.float64))
    names = tuple(f"cam_{i:02d}" for i in range(len(rig)))
    return CameraSet.from_cameras(names, cameras, 0 * rig.distortion, rig.size)


def predicted(folder: Path, offset, *words: str) -> Path:
    """The walk, seen exactly by the moved rig, in every format."""
    write_pose2sim(folder / "rig.toml", moved_rig(offset), {})
    given = [f"keypoints={points_file(folder, frames=FRAMES)}", f"cameras={folder / 'rig.toml'}"]
    predict(config(*given, "formats=[npz,csv,parquet,trc,c3d,html]", *words), folder / "out")
    return folder / "out"


def in_npz(path: Path) -> np.ndarray:
    with np.load(path / "poses.npz", allow_pickle=False) as stored:
        return stored["points"]


def in_csv(path: Path) -> np.ndarray:
    text = (path / "poses.csv").read_text(encoding="utf-8")
    lines = [line.split(",") for line in text.splitlines()]
    columns = [i for i, name in enumerate(lines[0]) if re.search(r"_[xyz]_mm$", name)]
    return np.array([[float(row[i]) for i in columns] for row in lines[1:]]).reshape(FRAMES, 17, 3)


def in_parquet(path: Path) -> np.ndarray:
    parquet = pytest.importorskip("pyarrow.parquet", reason="comes with ghpt[io]")
    table = parquet.read_table(path / "poses.parquet")
    names = [name for name in table.column_names if re.search(r"_[xyz]_mm$", name)]
    return np.stack([table[name].to_numpy() for name in names], axis=-1).reshape(FRAMES, 17, 3)


def in_trc(path: Path) -> np.ndarray:
    lines = (path / "poses.trc").read_text(encoding="utf-8").splitlines()
    rows = [line.rstrip("\t").split("\t") for line in lines[6:]]
    return np.array([[float(cell) for cell in row[2:]] for row in rows]).reshape(FRAMES, 17, 3)


def in_c3d(path: Path) -> np.ndarray:
    ezc3d = pytest.importorskip("ezc3d", reason="comes with ghpt[test]")
    file = ezc3d.c3d(str(path / "poses.c3d"))
    ours = file["parameters"]["GHPT"]
    origin = [float(x) for x in ours["ORIGIN"]["value"]] if "ORIGIN" in ours else [0.0, 0.0, 0.0]
    return file["data"]["points"][:3].transpose(2, 1, 0) + origin


def unpacked(packed: dict) -> np.ndarray:
    """The numbers of an array in the page, which counts them in steps of half a millimetre."""
    content = np.frombuffer(zlib.decompress(base64.b64decode(packed["data"])), np.uint8)
    low, high = content.reshape(2, -1, packed["row"]).astype(np.uint16)
    steps = np.cumsum(low + 256 * high, axis=0, dtype=np.uint16)
    return packed["offset"] + packed["step"] * steps


def in_html(path: Path) -> np.ndarray:
    text = (path / "poses.html").read_text(encoding="utf-8")
    data = json.loads(re.search(r'application/json">(.*?)</script>', text, re.DOTALL)[1])
    points = unpacked(data["points"]).reshape(FRAMES, 17, 3)
    stated = re.search(r"zero is at \((.*?)\) mm", data["about"])
    origin = [float(x) for x in stated[1].split(",")] if stated else [0.0, 0.0, 0.0]
    return points @ np.array(data["axes"]).T + origin


READERS = {
    "npz": in_npz,
    "csv": in_csv,
    "parquet": in_parquet,
    "trc": in_trc,
    "c3d": in_c3d,
    "html": in_html,
}


@pytest.fixture(scope="module")
def outputs(tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp
    return {name: predicted(folder("far"), offset) for name, offset in OFFSETS.items()}


@pytest.mark.parametrize("format", READERS)
@pytest.mark.parametrize("name", OFFSETS)
def test_positions_are_exact_in_every_format(outputs, name, format):
    truth = walk()[:FRAMES].numpy() + OFFSETS[name]
    error = np.abs(READERS[format](outputs[name]) - truth).max()
    at_the_zero = np.abs(READERS[format](outputs["at the zero"]) - walk()[:FRAMES].numpy()).max()
    assert error <= at_the_zero + LIMIT


def noisy_points(folder: Path) -> Path:
    """Seen with noise, so that weights matter, and with left and right exchanged in one view."""
    pixels = PIXELS[:FRAMES] + np.random.default_rng(0).normal(0, 3, PIXELS[:FRAMES].shape)
    pixels[2:4, 1] = pixels[2:4, 1][:, list(MIRROR)]
    return points_file(folder, pixels.astype(np.float64))


def learned(folder: Path, name: str) -> tuple[dict, np.ndarray]:
    """What an untrained model and the classical estimators make of it: the numbers, and the
    positions relative to the rig's offset."""
    write_pose2sim(folder / "rig.toml", moved_rig(OFFSETS[name]), {})
    given = [f"keypoints={noisy_points(folder)}", f"cameras={folder / 'rig.toml'}"]
    words = [f"ckpt={checkpoint(folder, 'pose')}", "formats=[npz]", "compare=[linear,m_estimator]"]
    numbers = numbers_of(config(*given, *words), folder / "out")
    return numbers, in_npz(folder / "out") - OFFSETS[name]


@pytest.fixture(scope="module")
def near_and_far(tmp_path_factory) -> list[tuple[dict, np.ndarray]]:
    torch.manual_seed(0)
    state = torch.get_rng_state()
    found = []
    for name in ("at the zero", "UTM"):
        torch.set_rng_state(state)  # the same untrained model
        found.append(learned(tmp_path_factory.mktemp("learned"), name))
    return found


def test_a_learned_model_and_swaps_do_not_depend_on_where_the_world_s_zero_is(near_and_far):
    (near, points), (far, moved) = near_and_far
    assert near["swapped"]["cam_01"] == 2
    assert far["swapped"] == near["swapped"]
    assert np.abs(moved - points).max() <= LIMIT


def test_the_comparison_of_estimators_does_not_depend_on_it_either(near_and_far):
    near, far = (numbers["evaluation"]["estimators"] for numbers, _ in near_and_far)
    assert len(near) == 3
    for name, found in near.items():
        for error in ("reprojection", "held_out"):
            assert far[name][error]["median"] == pytest.approx(found[error]["median"], abs=1e-3)
        variation = found["segments"]["median"]
        assert far[name]["segments"]["median"] == pytest.approx(variation, abs=1e-6)


def sequence_at(distance: float) -> Sequence:
    """A rig whose centre is so far along z, mm, and which shows nothing."""
    rig = human36m_rig("S9").cameras
    middle = rig.centre.nanmedian(0).values
    there = rig.relative_to(middle - torch.tensor([0.0, 0.0, distance]))
    cameras = CameraSet.from_cameras(("a", "b", "c", "d"), there)
    nothing = KeyPoints(np.zeros((1, 4, 17, 2)), np.zeros((1, 4, 17)), np.zeros((1, 4, 17), bool))
    return Sequence("", "", cameras, np.arange(1), None, KeyPointArrays(nothing, nothing))


def test_a_rig_within_100_m_stays_where_it_is_to_the_bit():
    sequence = sequence_at(99.9 * METRE)
    cameras = sequence.cameras.cameras
    assert sequence.origin.tolist() == [0, 0, 0]
    assert torch.equal(cameras.relative_to(sequence.origin).t, cameras.t)


@pytest.mark.parametrize("sign", [1, -1])
def test_one_farther_away_is_worked_on_near_its_centre_to_the_metre(sign):
    assert sequence_at(sign * 100.6 * METRE).origin.tolist() == [0, 0, sign * 101 * METRE]


def test_the_zero_of_single_precision_is_said_where_it_is_not_the_world_s(tmp_path, caplog):
    predicted(tmp_path, OFFSETS["UTM"])
    messages = [record.getMessage() for record in caplog.records]
    said = [message for message in messages if "single precision" in message]
    assert len(said) == 1
    assert "poses.c3d, poses.html" in said[0]
    assert re.search(r"zero is at \(5003\d\d000, 54123\d\d000, 31\d000\) mm", said[0])


def test_nothing_is_said_of_an_ordinary_rig_and_its_c3d_has_no_origin(tmp_path, caplog):
    out = predicted(tmp_path, OFFSETS["at the zero"])
    assert "single precision" not in caplog.text
    assert b"ORIGIN" not in (out / "poses.c3d").read_bytes()


def test_rerun_gets_positions_that_float32_holds(tmp_path, monkeypatch):
    rr = MagicMock()
    monkeypatch.setitem(sys.modules, "rerun", rr)
    monkeypatch.setitem(sys.modules, "rerun.blueprint", rr.blueprint)
    origin = tuple(round(x / METRE) * METRE for x in OFFSETS["UTM"])
    made = random_reconstruction(5, views=4, missing=0.0)
    far = replace(made, points=made.points + torch.tensor(OFFSETS["UTM"], dtype=torch.float64))
    who = replace(about(cameras=("a", "b", "c", "d")), origin=origin)
    pool = far.points[:, None].expand(-1, 2, -1, -1)
    evidence = Evidence(torch.zeros(5, 4, 17, 2), made.views, pool)
    scene = Scene(moved_rig(OFFSETS["UTM"]).cameras, lambda: iter([evidence]))
    WRITERS["rerun"].write(tmp_path / "poses.rrd", who, in_parts(far), scene=scene)
    joints, hypotheses = (call.kwargs["positions"] for call in rr.Points3D.columns.call_args_list)
    for shown, true in ((joints, far.points), (hypotheses, pool)):
        assert np.abs(shown + np.array(origin) - true.reshape(-1, 3).numpy()).max() <= LIMIT
    centres = [call.kwargs["translation"] for call in rr.Transform3D.call_args_list]
    assert np.abs(np.array(centres) + origin - scene.cameras.centre.numpy()).max() <= LIMIT
    name = rr.RecordingStream().send_recording_name.call_args.args[0]
    assert name.endswith("zero is at (500321000, 5412346000, 313000) mm of the cameras' world")


def test_the_page_s_cameras_are_where_its_joints_are(outputs):
    text = (outputs["UTM"] / "poses.html").read_text(encoding="utf-8")
    data = json.loads(re.search(r'application/json">(.*?)</script>', text, re.DOTALL)[1])
    stated = re.search(r"zero is at \((.*?)\) mm", data["about"])[1]
    centres = np.array([camera["centre"] for camera in data["cameras"]]) @ np.array(data["axes"]).T
    expected = moved_rig(OFFSETS["UTM"]).cameras.centre.numpy()
    found = centres + [float(x) for x in stated.split(",")]
    assert np.abs(found - expected).max() <= LIMIT
    assert np.abs(centres).max() < 10 * METRE


@pytest.mark.parametrize("write", [write_pose2sim, write_aniposelib, write_opencv])
def test_rig_files_have_the_digits(tmp_path, write):
    rig = moved_rig(OFFSETS["10,000 km"])
    if write is write_opencv:
        write(tmp_path, rig)
    else:
        write(tmp_path / "rig.toml", rig, {})
    read = read_cameras(tmp_path if write is write_opencv else tmp_path / "rig.toml")
    assert float((read.cameras.centre - rig.cameras.centre).abs().max()) <= LIMIT


def test_the_poses_of_a_calibration_have_them_too(tmp_path):
    points = walk()[:FRAMES] + torch.tensor(OFFSETS["10,000 km"], dtype=torch.float64)
    recording = MagicMock(spec=Recording, frame=np.arange(FRAMES), rate_hz=50.0)
    result = MagicMock(spec=CalibrationResult, scale=RigScale("height", "", 1.0))
    for name in ("data", "source", "world", "triangulation", "usable", "provenance"):
        setattr(result, name, None)
    estimated = torch.ones(FRAMES, 17, dtype=torch.bool)
    write_poses(tmp_path / "poses.npz", recording, points, estimated, result)
    assert np.abs(in_npz(tmp_path) - points.numpy()).max() == 0


def rewritten(path: Path, change) -> Path:
    """The npz file with ``change`` done to its arrays."""
    with np.load(path, allow_pickle=False) as stored:
        arrays = dict(stored)
    arrays = change(arrays)
    with zipfile.ZipFile(path, "w") as archive:
        for name, value in arrays.items():
            add_member(archive, name, value.dtype, value.shape, value.tobytes())
    return path


def with_meta(**changed):
    def change(arrays: dict) -> dict:
        meta = json.loads(str(arrays["meta"])) | changed
        kept = {key: value for key, value in meta.items() if value is not None}
        return arrays | {"meta": np.array(json.dumps(kept))}

    return change


def test_the_origin_comes_back(tmp_path):
    who = replace(about(), origin=(1e9, -2e9, 3000.0))
    WRITERS["npz"].write(tmp_path / "poses.npz", who, in_parts(random_reconstruction(3)))
    assert read_reconstruction(tmp_path / "poses.npz")[0] == who


def test_a_file_of_the_first_version_is_still_read(tmp_path):
    made = random_reconstruction(9, missing=0.0)
    WRITERS["npz"].write(tmp_path / "poses.npz", about(), in_parts(made))

    def first_version(arrays: dict) -> dict:
        changed = with_meta(format_version=1, origin=None)(arrays)
        return changed | {"points": arrays["points"].astype("<f4")}

    who, parts = read_reconstruction(rewritten(tmp_path / "poses.npz", first_version))
    read = next(parts)
    assert who == about()
    assert read.points.dtype == torch.float64
    assert torch.equal(read.points, made.points)  # made of float32


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"format_version": 4}, "is 4; this ghpt reads 1 and 2 and 3"),
        ({"format_version": True}, "is True"),
        ({"format_version": [2]}, "meta.format_version"),
        ({"format_version": 1}, "points: is not <f4"),
        ({"origin": [1.0, 2.0]}, "meta.origin"),
        ({"origin": [1.0, 2.0, float("nan")]}, "meta.origin"),
        ({"origin": "zero"}, "meta.origin"),
    ],
)
def test_a_version_or_an_origin_that_cannot_be_is_named(tmp_path, changed, said):
    WRITERS["npz"].write(tmp_path / "poses.npz", about(), in_parts(random_reconstruction(3)))
    with pytest.raises(GhptDataError, match=said):
        read_reconstruction(rewritten(tmp_path / "poses.npz", with_meta(**changed)))
