"""E1: what is written is read back by two independent readers of each format: numbers, names, rate,
units, gaps.
"""

import json
import struct
import warnings

import numpy as np
import pytest
import torch

from ghpt.export import WRITERS, read_reconstruction
from ghpt.export.c3d import RESIDUAL_STEP
from ghpt.export.stream import part
from ghpt.reconstruction import State
from ghpt.skeleton import JOINTS
from reconstructions import about, in_parts, random_reconstruction

EPSILON = np.finfo(np.float32).eps


def truth(made, count=None):
    """Positions as they must come back, NaN where missing."""
    return torch.where(made.has_position[..., None], made.points, torch.nan).numpy()


def difference(found, expected):
    """Largest difference; NaN must be where NaN is expected and nowhere else."""
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
    return float(np.nanmax(np.abs(found - expected), initial=0.0))


def written(path, format, who, made, **settings):
    """The file, written from uneven parts."""
    cut = len(made) // 3
    parts = in_parts(part(made, 0, cut), part(made, cut, len(made)))
    WRITERS[format].write(path / WRITERS[format].file, who, parts, **settings)
    return path / WRITERS[format].file


def opensim_table(path):
    """A TRC file as OpenSim's reader demands it, each rule an assertion: header, times, points [T,
    J, 3].
    """
    text = path.read_bytes().decode("utf-8")
    assert "\r" not in text
    assert "nan" not in text.lower()
    lines = text.split("\n")

    def cells(line):
        found = line.split("\t")
        return found[:-1] if found[-1] == "" else found  # nothing after the last tab is no cell

    assert lines[0].split("\t")[:3] == ["PathFileType", "4", "(X/Y/Z)"]
    keys = (
        "DataRate CameraRate NumFrames NumMarkers Units"
        " OrigDataRate OrigDataStartFrame OrigNumFrames"
    )
    assert lines[1].split("\t") == keys.split()
    header = dict(zip(keys.split(), lines[2].split("\t"), strict=True))
    markers = int(header["NumMarkers"])
    labels = [cell for cell in cells(lines[3]) if cell]
    assert labels[:2] == ["Frame#", "Time"]
    assert len(labels) == markers + 2
    assert cells(lines[3])[2::3] == labels[2:]
    assert [c for c in cells(lines[4]) if c] == [
        f"{a}{j}" for j in range(1, markers + 1) for a in "XYZ"
    ]
    assert lines[5] == ""
    assert lines[-1] == ""
    rows = [cells(line) for line in lines[6:-1]]
    assert len(rows) == int(header["NumFrames"])
    assert {len(row) for row in rows} == {3 * markers + 2}
    numbers = np.array([[float(cell) if cell else np.nan for cell in row] for row in rows])
    frames, times = numbers[:, 0], numbers[:, 1]
    assert (np.diff(frames) == 1).all()
    start, rate = int(header["OrigDataStartFrame"]), float(header["DataRate"])
    np.testing.assert_allclose(times, (frames - start) / rate, rtol=0, atol=1e-8)
    return header, labels[2:], frames, numbers[:, 2:].reshape(len(rows), markers, 3)


def ezc3d_table(path):
    ezc3d = pytest.importorskip("ezc3d", reason="ezc3d reads C3D; it comes with ghpt[test]")
    file = ezc3d.c3d(str(path))
    point = file["parameters"]["POINT"]
    labels = [
        label
        for key in sorted(k for k in point if k.startswith("LABELS"))
        for label in point[key]["value"]
    ]
    meta = file["data"]["meta_points"]
    return {
        "points": file["data"]["points"][:3].transpose(2, 1, 0),
        "labels": labels,
        "units": point["UNITS"]["value"],
        "rate": point["RATE"]["value"][0],
        "missing": meta["residuals"][0].T < 0,
        "parameters": file["parameters"],
    }


def py_c3d_table(path):
    c3d = pytest.importorskip("c3d", reason="c3d reads C3D; it comes with ghpt[test]")
    with open(path, "rb") as handle, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reader = c3d.Reader(handle)
        frames = np.stack([points for _, points, _ in reader.read_frames()])
        labels = reader.get("POINT:LABELS").bytes_array
        found = {
            "labels": [bytes(label).decode().rstrip() for label in labels],
            "rate": reader.point_rate,
            "units": [reader.get("POINT:UNITS").string_value.strip()],
            "residual": frames[..., 3],
            "missing": frames[..., 3] < 0,
            "mask": frames[..., 4],
        }
    found["points"] = np.where(frames[..., 3:4] < 0, np.nan, frames[..., :3])
    return found


def check_c3d(path, who, made):
    """Both readers' findings against what was written; the greatest error over float32's of the
    value.
    """
    worst = 0.0
    expected = truth(made)
    observed = made.is_measured.numpy()
    residual = np.where(
        observed, np.clip(np.round(made.error.numpy() / RESIDUAL_STEP), 1, 255) * RESIDUAL_STEP, 0
    )
    residual = np.where(made.has_position.numpy(), residual, -1)
    for found in (ezc3d_table(path), py_c3d_table(path)):
        error = np.abs(found["points"] - expected) / (EPSILON * np.maximum(np.abs(expected), 1e-30))
        np.testing.assert_array_equal(np.isnan(found["points"]), np.isnan(expected))
        worst = max(worst, float(np.nanmax(error, initial=0.0)))
        np.testing.assert_array_equal(found["missing"], ~made.has_position.numpy())
        assert list(found["labels"]) == list(who.joints)
        assert list(found["units"]) == ["mm"]
        assert found["rate"] == pytest.approx(who.rate_hz, rel=1e-7)
    # ezc3d 1.7 takes the high byte for the residual and the low one for the mask; c3d.org has it
    # the other way round.
    np.testing.assert_array_equal(found["residual"], residual)
    bits = (made.views[:, :7] * 2 ** torch.arange(made.views[:, :7].shape[1])[:, None]).sum(1)
    np.testing.assert_array_equal(
        found["mask"], np.where(made.has_position.numpy(), bits.numpy(), 127)
    )
    return worst


@pytest.mark.parametrize("frames", [1, 2, 300])
def test_e1_c3d(tmp_path, frames, record_row):
    made, who = random_reconstruction(frames, seed=frames), about()
    worst = check_c3d(written(tmp_path, "c3d", who, made), who, made)
    record_row("E1", f"C3D, {frames} frames: {worst:.2g} x float32's eps", int(worst <= 1), 1)
    assert worst <= 1


@pytest.mark.parametrize("frames", [32_767, 32_768, 65_535, 65_536, 65_537])
def test_e1_c3d_around_the_limits_of_its_counts(tmp_path, frames):
    """ezc3d reads all; the mean and the last frame are where they belong."""
    made, who = random_reconstruction(frames, joints=2, seed=1), about(("a", "b"))
    found = ezc3d_table(written(tmp_path, "c3d", who, made))
    assert found["points"].shape == (frames, 2, 3)
    assert difference(found["points"], truth(made)) == 0
    end = found["parameters"]["TRIAL"]["ACTUAL_END_FIELD"]["value"]
    low, high = (int(word) & 0xFFFF for word in end)
    assert low + high * 65536 == frames


@pytest.mark.parametrize("frames", [32_768, 65_536])
def test_e1_c3d_long_recordings_with_the_second_reader(tmp_path, frames):
    made, who = random_reconstruction(frames, joints=1, seed=1), about(("a",))
    found = py_c3d_table(written(tmp_path, "c3d", who, made))
    assert difference(found["points"], truth(made)) == 0


@pytest.mark.parametrize(
    "joints",
    [
        ("a",),
        tuple(f"j{i}" for i in range(255)),
        ("x" * 255, "y"),
        ("колено", "膝", "genou gauche"),
        ("é" * 127, "b"),
    ],
    ids=["one", "255", "255 bytes", "UTF-8", "254 bytes of UTF-8"],
)
def test_e1_labels(tmp_path, joints):
    made, who = random_reconstruction(3, joints=len(joints), seed=4), about(joints)
    if len(joints) * max(len(j.encode()) for j in joints) < 30_000:
        assert check_c3d(written(tmp_path, "c3d", who, made), who, made) <= 1
    _, labels, _, points = opensim_table(written(tmp_path, "trc", who, made))
    assert labels == list(joints)
    assert difference(points, truth(made)) <= 1e-3
    assert read_reconstruction(written(tmp_path, "npz", who, made))[0] == who


def test_e1_more_labels_than_c3d_lists_at_once(tmp_path):
    joints = tuple(f"joint_{i}" for i in range(256))
    made, who = random_reconstruction(2, joints=256, seed=5), about(joints)
    found = ezc3d_table(written(tmp_path, "c3d", who, made))
    assert tuple(found["labels"]) == joints
    assert difference(found["points"], truth(made)) == 0


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1.0), ("m", 1e-3)])
def test_e1_trc(tmp_path, unit, factor, record_row):
    made, who = random_reconstruction(200, seed=2, first=17), about()
    header, labels, frames, points = opensim_table(written(tmp_path, "trc", who, made, unit=unit))
    metres = difference(points, truth(made).astype(float) * factor) * (1e-3 if unit == "mm" else 1)
    record_row("E1", f"TRC in {unit}: {metres:.2g} m", int(metres <= 1e-6), 1)
    assert metres <= 1e-6
    assert (header["Units"], header["DataRate"], header["CameraRate"]) == (unit, "29.97", "29.97")
    assert tuple(labels) == JOINTS
    assert frames.tolist() == list(range(17, 217))


def test_e1_npz_by_numpy_and_by_its_own_reader(tmp_path):
    made, who = random_reconstruction(50, seed=6), about()
    path = written(tmp_path, "npz", who, made)
    with np.load(path, allow_pickle=False) as stored:
        assert difference(stored["points"], truth(made)) == 0
        np.testing.assert_array_equal(stored["state"], made.state.numpy())
        assert np.isnan(stored["error"])[(~made.is_measured).numpy()].all()
        assert (str(stored["unit"]), float(stored["rate_hz"])) == ("mm", 29.97)
        assert tuple(stored["joints"]) == JOINTS
        assert json.loads(str(stored["meta"]))["provenance"] == {"seed": 3, "commit": "abc"}
    read, parts = read_reconstruction(path, size=7)
    assert read == who
    parts = list(parts)
    assert [len(p) for p in parts] == [7] * 7 + [1]
    for field in ("frame", "state", "error", "views", "covariance", "score", "flipped"):
        assert torch.equal(torch.cat([getattr(p, field) for p in parts]), getattr(made, field)), (
            field
        )
    points = torch.cat([p.points for p in parts])
    assert torch.equal(points, torch.where(made.has_position[..., None], made.points, 0.0))


def test_e1_parquet(tmp_path):
    parquet = pytest.importorskip(
        "pyarrow.parquet", reason="pyarrow reads Parquet; it comes with ghpt[io]"
    )
    made, who = random_reconstruction(50, seed=7), about()
    table = parquet.read_table(written(tmp_path, "parquet", who, made))
    columns = [table[f"{joint}_{axis}_mm"] for joint in JOINTS for axis in "xyz"]
    found = np.array(
        [[np.nan if v is None else v for v in c.to_pylist()] for c in columns]
    ).T.reshape(50, 17, 3)
    assert difference(found, truth(made)) == 0
    assert sum(c.null_count for c in columns) == 3 * int((~made.has_position).sum())
    notes = json.loads(table.schema.metadata[b"ghpt"])
    assert (notes["rate_hz"], notes["unit"], tuple(notes["joints"])) == (29.97, "mm", JOINTS)


def test_e1_csv(tmp_path):
    made, who = random_reconstruction(50, seed=8), about()
    lines = written(tmp_path, "csv", who, made).read_text(encoding="utf-8").splitlines()
    names, rows = lines[0].split(","), [line.split(",") for line in lines[1:]]
    cells = {name: [row[i] for row in rows] for i, name in enumerate(names)}
    columns = [cells[f"{joint}_{axis}_mm"] for joint in JOINTS for axis in "xyz"]
    found = np.array([[float(c or "nan") for c in column] for column in columns])
    found = found.T.reshape(50, 17, 3)
    assert difference(found, truth(made)) <= 0.5001e-6  # six decimals of a millimetre
    assert cells["frame"] == [str(i) for i in range(50)]
    states = [State[s.upper()] for s in cells["nose_state"]]
    assert states == made.state[:, JOINTS.index("nose")].tolist()


def test_e1_nightly_a_million_frames(tmp_path, nightly, record_row):
    if not nightly:
        pytest.skip("a million frames take half a minute; GHPT_NIGHTLY=1")
    made, who = random_reconstruction(1_000_000, joints=1, seed=9), about(("a",))
    found = ezc3d_table(written(tmp_path, "c3d", who, made))
    worst = difference(found["points"], truth(made))
    _, _, _, points = opensim_table(written(tmp_path, "trc", who, made))
    trc = difference(points, truth(made))
    record_row(
        "E1",
        f"1e6 frames: C3D {worst:.2g} mm, TRC {trc:.2g} mm",
        int(worst == 0 and trc <= 1e-3),
        1,
    )
    assert worst == 0
    assert trc <= 1e-3


def test_the_header_of_c3d_says_what_its_parameters_say(tmp_path):
    made, who = random_reconstruction(5, seed=10), about()
    data = written(tmp_path, "c3d", who, made).read_bytes()
    first = struct.unpack("<BBHHHHHfHHf", data[:24])
    assert first[:6] == (2, 0x50, 17, 0, 1, 5)
    assert first[7] == -RESIDUAL_STEP
    assert first[10] == pytest.approx(29.97)
    assert len(data) % 512 == 0
    assert len(data) == -(-5 * 17 * 16 // 512) * 512 + 512 * (first[8] - 1)
