import io
import json
import tracemalloc
import zipfile

import numpy as np
import pytest
import torch

from ghpt.errors import GhptDataError, GhptError
from ghpt.geometry.cameras import Cameras
from ghpt.models.aggregation import WeightSummary
from ghpt.models.pose.schema import POSES, PoseSample, PoseTables
from ghpt.models.predictions import Predictions, PredictionWriter, open_predictions, with_nan
from ghpt.observations import PoseEstimate, Recording, Truth

NAMES = ("weight", "average", "linear")
META = {
    "data": "h36m",
    "source": "synthetic",
    "split": "test",
    "seed": 0,
    "provenance": {"commit": "abc"},
}


def recording(subject: str, action: str) -> Recording:
    """A recording of no frames."""
    cameras = Cameras(torch.zeros(2, 3, 3), torch.zeros(2, 3, 3), torch.zeros(2, 3))
    views, mask = np.zeros((0, 2, 17, 2), np.float32), np.zeros((0, 2, 17), bool)
    return Recording(
        name=f"{subject}/{action}",
        subject=subject,
        action=action,
        rate_hz=50.0,
        camera_names=("a", "b"),
        cameras=cameras,
        key_points=views,
        confidence=views[..., 0],
        valid=mask,
        frame=np.zeros(0, np.int64),
    )


RECORDINGS = PoseTables.from_recordings(
    [
        recording(subject, action)
        for subject, action in (("S9", "Eating"), ("S9", "Walking"), ("S11", "Eating"))
    ]
)


def rows(index: torch.Tensor) -> dict:
    """What row i holds is a function of i alone, so any process can write any row."""
    points = index[:, None, None] * 100.0 + torch.arange(51).reshape(17, 3)
    truth = Truth(points - 1, (index[:, None] + torch.arange(17)) % 7 > 0)
    here = (index[:, None] + torch.arange(17)) % 5 > 0
    return {
        "estimates": {name: PoseEstimate(points + 10 * i, here) for i, name in enumerate(NAMES)},
        "sample": PoseSample(with_nan(truth), truth.valid, index % 3, 64 * index),
        "weights": WeightSummary(*(index.float() + i for i in range(3))),
    }


def opened(path) -> Predictions:
    return open_predictions(path, POSES)


def write_all(tmp_path, count: int = 20, name: str = "predictions.npz", order=None):
    path = tmp_path / name
    index = torch.arange(count) if order is None else order
    writer = PredictionWriter(tmp_path / "rows", count, NAMES, POSES)
    for part in index.split(7):
        writer.write(part, **rows(part))
    writer.finish(path, RECORDINGS, META)
    return path


def test_round_trip(tmp_path):
    predictions = opened(write_all(tmp_path))
    assert len(predictions) == 20
    assert predictions.names == NAMES
    assert predictions.tables.recording_action.tolist() == ["Eating", "Walking", "Eating"]
    assert {**META, "unit": "mm"}.items() <= predictions.meta.items()
    chunks, expected = list(predictions.chunks(6)), rows(torch.arange(20))
    assert [len(chunk.sample.frame) for chunk in chunks] == [6, 6, 6, 2]
    truth = expected["sample"].as_truth()
    assert torch.equal(torch.cat([c.sample.as_truth().valid for c in chunks]), truth.valid)
    assert torch.equal(torch.cat([c.sample.as_truth().points for c in chunks]), truth.points)
    for field in ("frame", "recording"):
        stored = torch.cat([getattr(c.sample, field) for c in chunks])
        assert torch.equal(stored, getattr(expected["sample"], field))
    for name, estimate in expected["estimates"].items():
        assert torch.equal(
            torch.cat([c.estimates[name].estimated for c in chunks]), estimate.estimated
        )
        points = torch.cat([c.estimates[name].points for c in chunks])
        assert torch.equal(points, estimate.points * estimate.estimated[..., None])
    for field in ("entropy", "max", "effective"):
        stored = torch.cat([getattr(c.weights, field) for c in chunks])
        assert torch.equal(stored, getattr(expected["weights"], field))


def test_numpy_alone_reads_it_and_missing_is_nan(tmp_path):
    with np.load(write_all(tmp_path), allow_pickle=False) as arrays:
        expected = rows(torch.arange(20))["estimates"]["average"]
        np.testing.assert_array_equal(
            ~np.isnan(arrays["points_average"]).any(-1), expected.estimated
        )
        np.testing.assert_array_equal(
            arrays["points_average"][expected.estimated], expected.points[expected.estimated]
        )
        np.testing.assert_array_equal(np.isnan(arrays["truth"]).any(-1), ~arrays["truth_seen"])
        assert arrays["joint_name"][6] == "pelvis"
        assert json.loads(str(arrays["meta"]))["source"] == "synthetic"


def test_bytes_depend_on_the_content_alone(tmp_path):
    one = write_all(tmp_path, name="one.npz").read_bytes()
    shuffled = torch.randperm(20, generator=torch.Generator().manual_seed(0))
    again = torch.cat((shuffled, shuffled[:3]))  # a padding sampler repeats rows
    assert write_all(tmp_path, name="two.npz", order=again).read_bytes() == one


def test_two_writers_make_the_file_of_one(tmp_path):
    writers = [
        PredictionWriter(tmp_path / "shared", 20, NAMES, POSES) for _ in range(2)
    ]  # as two processes have them
    for start in range(0, 20, 4):
        for rank, writer in enumerate(writers):
            index = torch.arange(start + rank, start + 4, 2)
            writer.write(index, **rows(index))
    writers[0].finish(tmp_path / "two.npz", RECORDINGS, META)
    assert (tmp_path / "two.npz").read_bytes() == write_all(tmp_path, name="one.npz").read_bytes()
    assert not (tmp_path / "shared").exists()


def test_a_missing_row_is_an_error_and_keeps_the_old_file(tmp_path):
    path = tmp_path / "predictions.npz"
    path.write_bytes(b"old")
    writer = PredictionWriter(tmp_path / "rows", 20, NAMES, POSES)
    writer.write(torch.arange(19), **rows(torch.arange(19)))
    with pytest.raises(GhptError, match="1 of 20 samples have no prediction"):
        writer.finish(path, RECORDINGS, META)
    assert path.read_bytes() == b"old"


def test_a_point_that_is_not_finite_is_not_estimated(tmp_path):
    index = torch.arange(2)
    values = rows(index)
    spoilt = values["estimates"]["weight"].points.clone()
    spoilt[0, 1, 2] = torch.inf
    values["estimates"]["weight"] = PoseEstimate(spoilt, torch.ones(2, 17, dtype=torch.bool))
    writer = PredictionWriter(tmp_path / "rows", 2, NAMES, POSES)
    writer.write(index, **values)
    writer.finish(tmp_path / "p.npz", RECORDINGS, META)
    estimate = opened(tmp_path / "p.npz").read(0, 2).estimates["weight"]
    assert estimate.estimated.sum() == 33
    assert not estimate.estimated[0, 1]


def changed(path, tmp_path, change):
    """The same arrays, zipped anew after ``change`` edited the dictionary of their bytes."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    with zipfile.ZipFile(tmp_path / "changed.npz", "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return tmp_path / "changed.npz"


def array(value) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, value, allow_pickle=True)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("member", "value", "field"),
    [
        ("truth", np.zeros((19, 17, 3), np.float32), "truth"),
        ("truth", np.zeros((20, 17, 3), np.float64), "truth"),
        ("estimated_linear", None, "estimated_linear"),
        ("joint_name", np.array(["a"] * 17), "joint_name"),
        ("recording_action", np.array(["a"]), "recording_name"),
        ("meta", np.array('{"format_version": 2}'), "format_version"),
        ("meta", np.array('{"format_version": 1, "names": "x"}'), "names"),
        ("meta", np.array("[" * 100000), "not a readable"),
        ("meta", np.array(["no", "json"]), "not a readable"),
        ("meta", np.array({"code": 1}, dtype=object), "not a readable"),
        ("recording_name", np.array([1, 2, 3]), "not a readable"),
        (
            "meta",
            np.array('{"format_version": 1, "names": ["linear"], "problem": "camera"}'),
            "problem",
        ),
    ],
)
def test_arrays_that_do_not_belong_together_are_refused(tmp_path, member, value, field):
    def change(members):
        if value is None:
            del members[f"{member}.npy"]
        else:
            members[f"{member}.npy"] = array(value)

    path = changed(write_all(tmp_path), tmp_path, change)
    with pytest.raises(GhptDataError, match=field) as caught:
        opened(path)
    assert str(path) in str(caught.value)


def test_a_recording_out_of_range_is_refused(tmp_path):
    recordings = {"recording.npy": array(np.full(20, 3, np.int32))}
    path = changed(write_all(tmp_path), tmp_path, lambda members: members.update(recordings))
    with pytest.raises(GhptDataError, match="recording"):
        opened(path).read(0, 1)


def test_every_truncation_and_every_kind_of_damage_is_refused(tmp_path):
    path = write_all(tmp_path, count=1)
    whole = path.read_bytes()
    for length in range(0, len(whole), 97):
        path.write_bytes(whole[:length])
        with pytest.raises(GhptDataError):
            opened(path)
    generator = np.random.default_rng(0)
    accepted = 0
    for _ in range(400):
        content = bytearray(whole)
        content[generator.integers(len(whole))] ^= 1 << int(generator.integers(8))
        path.write_bytes(content)
        try:
            again = opened(path)
        except GhptDataError:
            continue
        accepted += 1  # dates and the like: but then all values must be the same
        path.write_bytes(whole)
        original = opened(path)
        assert again.meta == original.meta
        assert again.members == original.members
    assert accepted < 100
    with pytest.raises(GhptDataError, match="no such file"):
        opened(tmp_path / "absent.npz")


def test_a_compressed_file_is_refused_before_it_is_unpacked(tmp_path):
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.npy", bytes(50 << 20))
    tracemalloc.start()
    with pytest.raises(GhptDataError, match="compressed"):
        opened(path)
    assert tracemalloc.get_traced_memory()[1] < 4 << 20
    tracemalloc.stop()


def test_memory_does_not_grow_with_frames(tmp_path):
    def peak(count: int) -> int:
        writer = PredictionWriter(tmp_path / "rows", count, NAMES, POSES)
        values = rows(torch.arange(1000))
        tracemalloc.start()
        for start in range(0, count, 1000):
            writer.write(torch.arange(start, start + 1000), **values)
        writer.finish(tmp_path / "p.npz", RECORDINGS, META)
        for _ in opened(tmp_path / "p.npz").chunks(1000):
            pass
        result = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return result

    assert peak(40_000) < 1.1 * peak(10_000)
