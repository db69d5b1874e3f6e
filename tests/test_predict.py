"""predict.py as a user meets it: what it writes and says, how it goes on, and how it fails."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import children
import sizes
from composed import compose
from ghpt.commands import predict as module
from ghpt.commands.predict import COMMAND, predict
from ghpt.commands.prediction import sequences
from ghpt.config import build
from ghpt.data.formats.camera_writers import write_pose2sim
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.export import read_reconstruction
from ghpt.geometry.cameras import Cameras, CameraSet, project
from ghpt.models.checkpoint import FORMAT_VERSION, AtomicCheckpointIO
from ghpt.reconstruction import State
from ghpt.skeleton import JOINTS
from predicting import (
    CONF,
    QUICK,
    cameras_file,
    config,
    numbers_of,
    openpose_folders,
    sequence_of,
    walk,
    write_people,
)
from single_person import SinglePerson, write_person

pytestmark = pytest.mark.usefixtures("blank_figures")

ROOT = Path(__file__).resolve().parents[1]
RIG = human36m_rig("S9")
PIXELS = project(RIG.cameras, walk())[0].numpy()


@pytest.fixture
def command(monkeypatch, typed):
    """``command(*words)`` runs predict.py in this process: (exit status, stdout, stderr)."""
    monkeypatch.setenv("COLUMNS", "120")
    return lambda *words: typed(CONF, COMMAND, [*words, *QUICK])


def points_file(folder: Path, values=None, name="points.npz", frames=40, **changed) -> Path:
    """The walk in Human3.6M's cameras as an npz file of ours."""
    values = PIXELS[:frames].astype(np.float64) if values is None else values
    valid = np.isfinite(values).all(-1)
    points = SinglePerson(
        "",
        tuple(f"cam{i}_json" for i in range(values.shape[1])),
        JOINTS,
        np.arange(len(values)),
        np.where(valid[..., None], values, 0),
        valid.astype(float),
        valid,
        50.0,
    )
    write_person(folder / name, SinglePerson(**{**vars(points), **changed}))
    return folder / name


ALONE = "estimator=frame"
"""Estimates each frame alone, which is quicker, where the estimator is not the point."""


def words(folder: Path, points: Path) -> list[str]:
    return [f"keypoints={points}", f"cameras={cameras_file(folder)}", f"output={folder / 'out'}"]


def result(folder: Path):
    about, parts = read_reconstruction(folder / "out" / "poses.npz")
    return about, next(iter(parts))


def checkpoint(folder: Path, model: str) -> Path:
    """An untrained model, as train.py stores it."""
    small = [f"model={model}", "model.hypotheses=8", "model.scorer.layers=[4]"]
    settings = compose("train", *small)["model"]
    built = build(settings, "model")
    built.scorer.standardise.fit(torch.randn(100, built.problem.feature_size))
    ours = {
        "format_version": FORMAT_VERSION,
        "config": {"model": settings},
        "provenance": {"data": "toys"},
    }
    content = {"ghpt": ours, "state_dict": built.state_dict()}
    AtomicCheckpointIO().save_checkpoint(content, folder / f"{model}.ckpt")
    return folder / f"{model}.ckpt"


def test_a_folder_and_cameras_give_poses_in_every_format(command, tmp_path):
    openpose_folders(tmp_path / "pose", list(range(20)))
    status, said, errors = command(
        *words(tmp_path, tmp_path / "pose"), "skeleton=human36m", "rate_hz=50"
    )
    assert status == 0, errors
    there = {path.name for path in (tmp_path / "out").iterdir()}
    assert there >= {
        "poses.npz",
        "poses.csv",
        "poses.trc",
        "poses.c3d",
        "poses.html",
        "report.md",
        "report.html",
        "prediction.json",
    }
    assert 'class="notice good"' in (tmp_path / "out" / "report.html").read_text()
    about, found = result(tmp_path)
    assert about.camera_names == tuple(f"cam_{i:02d}" for i in range(4))
    assert about.rate_hz == 50
    assert not about.smoothed
    assert float((found.points.double() - walk()[:20]).norm(dim=-1).max()) < 4
    # without a checkpoint it says what it is: in the terminal, the report and the files
    for text in (
        said,
        errors,
        (tmp_path / "out" / "report.md").read_text(),
        json.dumps(about.provenance),
    ):
        assert "the trajectory of the whole recording" in text


def test_without_a_rate_the_formats_that_need_one_are_left_out_or_refused(command, tmp_path):
    openpose_folders(tmp_path / "pose", list(range(5)))
    status, _, said = command(*words(tmp_path, tmp_path / "pose"), "skeleton=human36m", ALONE)
    assert status == 0, said
    assert "no trc and c3d. Give rate_hz=60" in said
    assert not (tmp_path / "out" / "poses.trc").exists()
    status, _, said = command(
        *words(tmp_path, tmp_path / "pose"), "skeleton=human36m", "formats=[c3d]"
    )
    assert status == 1
    assert "error: rate_hz: is unknown, and c3d needs it" in said


def test_the_same_command_again_predicts_nothing_and_gives_the_same_bytes(tmp_path, monkeypatch):
    settings = config(*words(tmp_path, points_file(tmp_path)), "shard_frames=16", ALONE)
    predict(settings, tmp_path / "out")
    before = {path.name: path.read_bytes() for path in (tmp_path / "out").glob("poses.*")}
    calls = []
    monkeypatch.setattr(module, "predict_shards", refusing(module.predict_shards, calls))
    predict(settings, tmp_path / "out")
    assert calls == [0]
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").glob("poses.*")} == before
    (tmp_path / "out" / ".shards" / "000001.npz").unlink()
    predict(settings, tmp_path / "out")
    assert calls == [0, 1]
    predict(
        replace(settings, seed=1, fill=3, formats=["npz"]), tmp_path / "out"
    )  # none of the prediction's business
    predict(replace(settings, evaluated_frames=9), tmp_path / "out")
    assert calls == [0, 1, 0, 0]


def refusing(real, calls):
    """Counts how many shards are predicted."""

    def counted(frames, predictor, weights, folder, key, settings):
        before = {path.name: path.stat().st_mtime_ns for path in folder.glob("*.npz")}
        manager = real(frames, predictor, weights, folder, key, settings)

        class Counting:
            def __enter__(self):
                shards = manager.__enter__()
                after = {path.name: path.stat().st_mtime_ns for path in folder.glob("*.npz")}
                calls.append(sum(before.get(name) != when for name, when in after.items()))
                return shards

            def __exit__(self, *error):
                return manager.__exit__(*error)

        return Counting()

    return counted


def test_other_key_points_start_anew(tmp_path, caplog):
    predict(config(*words(tmp_path, points_file(tmp_path))), tmp_path / "out")
    moved = PIXELS[:40].astype(np.float64)
    moved[7, 1, 3] += 30
    with caplog.at_level("INFO"):
        predict(config(*words(tmp_path, points_file(tmp_path, moved))), tmp_path / "out")
    assert "starting anew" in caplog.text
    assert not result(tmp_path)[1].views[7, 1, 3]  # set aside


@pytest.mark.parametrize("shard_frames", sizes.representatives([7], [1, 40]))
def test_the_result_does_not_depend_on_shards_and_batches(tmp_path, shard_frames):
    values = PIXELS[:40] + np.random.default_rng(0).normal(0, 3, PIXELS[:40].shape)
    given = words(tmp_path, points_file(tmp_path, values))
    predict(config(*given), tmp_path / "out")
    _, whole = result(tmp_path)
    predict(config(*given, f"shard_frames={shard_frames}", "batch=3"), tmp_path / "out")
    _, cut = result(tmp_path)
    assert torch.equal(whole.state, cut.state)
    torch.testing.assert_close(whole.points, cut.points, rtol=0, atol=1e-3)


def test_filled_and_smoothed_is_marked(tmp_path):
    values = PIXELS[:40].astype(np.float64)
    values[10:13] = np.nan
    values[20:29, :, 5] = np.nan
    given = words(tmp_path, points_file(tmp_path, values))
    predict(config(*given, "formats=[npz]"), tmp_path / "out")
    about, plainly = result(tmp_path)
    assert not about.smoothed
    assert (plainly.state[10:13] == State.FEW_VIEWS).all()
    numbers = numbers_of(config(*given, "formats=[npz]", "fill=0.1s", "smooth=6"), tmp_path / "out")
    about, found = result(tmp_path)
    assert about.smoothed
    assert about.provenance["smooth_hz"] == 6
    assert about.provenance["fill_frames"] == 5
    assert (found.state[10:13] == State.FILLED).all()
    assert (found.state[20:29, 5] == State.FEW_VIEWS).all()
    assert float((found.points[10:13].double() - walk()[10:13]).norm(dim=-1).max()) < 60
    assert numbers["share"]["filled"] == pytest.approx(3 * 17 / (40 * 17))


def test_stored_and_compressed_key_points_give_the_same(tmp_path):
    values = PIXELS[:40].astype(np.float64)
    values[5, 1, 2] = np.nan
    packed = points_file(tmp_path, values)
    with np.load(packed) as arrays:
        np.savez(tmp_path / "stored.npz", **arrays)
    found = []
    for name in ("points.npz", "stored.npz"):
        given = words(tmp_path, tmp_path / name)
        predict(config(*given, "formats=[npz]", ALONE), tmp_path / "out")
        found.append(result(tmp_path)[1])
    for one, other in zip(vars(found[0]).values(), vars(found[1]).values(), strict=True):
        assert torch.equal(one, other)


def test_a_trained_model_predicts_and_says_so(command, tmp_path):
    ckpt = checkpoint(tmp_path, "pose")
    status, said, errors = command(
        *words(tmp_path, points_file(tmp_path)),
        f"ckpt={ckpt}",
        "hypotheses=6",
        "compare=[linear]",
    )
    assert status == 0, errors
    assert "pose.ckpt, trained on toys" in said
    about, found = result(tmp_path)
    assert about.estimator == "weight"
    assert about.provenance["settings"]["hypotheses"] == 6
    assert float((found.points.double() - walk()[:40]).norm(dim=-1).max()) < 4
    assert found.score.abs().sum() > 0


def test_a_sweep_takes_many_recordings_and_names_the_bad_one(command, tmp_path):
    good, cameras, out = points_file(tmp_path), cameras_file(tmp_path), tmp_path / "out"
    (tmp_path / "bad.npz").write_bytes(good.read_bytes()[:-40])
    status, said, _ = command(
        "-m",
        f"keypoints={tmp_path / 'bad.npz'},{good}",
        f"cameras={cameras}",
        f"output={out}",
        "formats=[npz]",
        ALONE,
        "hydra.sweep.subdir=${hydra.job.num}",
    )
    assert status == 1
    assert "1: points.npz with cameras.toml: 40 frames, 100.0 % observed" in said
    assert "0: error:" in said
    assert (out / "1" / "poses.npz").exists()
    assert not (out / "0" / "poses.npz").exists()


def spoilt(folder: Path, kind: str) -> list[str]:
    """A command that cannot work."""
    values = PIXELS[:20].astype(np.float64)
    points, cameras = points_file(folder, values), cameras_file(folder)
    if kind == "empty folder":
        (folder / "pose").mkdir()
        points = folder / "pose"
    elif kind == "truncated JSON":
        points = openpose_folders(folder / "pose", [1, 2, 3])
        (points / "cam2_json" / "cam2_000002.json").write_text('{"people": [{"pose_key')
    elif kind == "all confidences zero":
        points = openpose_folders(folder / "pose", [1, 2, 3])
        for path in points.rglob("*.json"):
            write_people(path, [torch.full((17, 2), torch.nan)])
        return [f"keypoints={points}", f"cameras={cameras}", "skeleton=human36m"]
    elif kind == "a view without a camera":
        points = points_file(folder, values, views=("cam0", "cam1", "cam2", "cam9"))
    elif kind == "one view":
        return [f"keypoints={points}", f"cameras={cameras}", "views=[cam_01]"]
    elif kind == "another image size":
        points = points_file(folder, 3 * values)
    elif kind == "all NaN":
        np.savez(
            points,
            key_points=values * np.nan,
            views=np.array([f"cam{i}" for i in range(4)]),
            joints=JOINTS,
        )
    elif kind == "unknown skeleton":
        np.savez(
            points, key_points=values[:, :, :11], views=np.array([f"cam{i}" for i in range(4)])
        )
    elif kind == "no extrinsics":
        same = Cameras(
            RIG.cameras.K, RIG.cameras.R[:1].expand(4, 3, 3), RIG.cameras.t[:1].expand(4, 3)
        )
        names = tuple(f"cam_{i:02d}" for i in range(4))
        write_pose2sim(
            cameras, CameraSet.from_cameras(names, same, 0 * RIG.distortion, RIG.size), {}
        )
    elif kind == "no cameras":
        return [f"keypoints={points}"]
    elif kind == "camera checkpoint":
        return [f"keypoints={points}", f"cameras={cameras}", f"ckpt={checkpoint(folder, 'camera')}"]
    elif kind == "no checkpoint":
        return [f"keypoints={points}", f"cameras={cameras}", "ckpt=nowhere.ckpt"]
    else:
        return [f"keypoints={points}", f"cameras={cameras}", kind]
    return [f"keypoints={points}", f"cameras={cameras}"]


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("empty folder", "is not a key-point format that is known"),
        ("truncated JSON", r"cam2_000002\.json.*not valid JSON"),
        ("all confidences zero", "no key point|is empty"),
        ("a view without a camera", "view cam9 has no camera"),
        ("one view", "there is only cam_01"),
        ("another image size", "lie outside"),
        ("all NaN", "no key point"),
        ("unknown skeleton", "no known skeleton has 11 joints"),
        ("no extrinsics", r"are not there for cam_00, .*calibrate\.py"),
        ("no cameras", "cameras: is missing"),
        ("camera checkpoint", r"is of a RelativePose: it has no pool of poses.*model=pose"),
        ("no checkpoint", "there is no such file"),
        ("formats=[bvh]", "formats: there is no 'bvh'"),
        ("compare=[magic]", "compare: there is no 'magic'"),
        ("fill=long", "fill: is 'long'"),
        ("smooth=40", "smooth: is 40 Hz"),
        ("shard_frames=0", "shard_frames: is 0"),
        ("person=3", "there is no person 3"),
    ],
)
def test_what_cannot_work_is_one_line_and_leaves_nothing(command, tmp_path, kind, said):
    status, _, errors = command(*spoilt(tmp_path, kind), f"output={tmp_path / 'out'}")
    assert status == 1
    last = errors.strip().splitlines()[-1]
    assert last.startswith("error: ")
    assert re.search(said, last), last
    assert not list((tmp_path / "out").glob("poses.*"))


def test_absurd_numbers_spoil_their_own_joint_only(tmp_path):
    values = PIXELS[:20].astype(np.float64)
    values[4, 2, 6] = 1e6
    values[5, 1, 7] = np.nan
    values[6, 0] = -999999.0
    predict(
        config(*words(tmp_path, points_file(tmp_path, values)), "formats=[npz]"), tmp_path / "out"
    )
    _, found = result(tmp_path)
    assert (found.state == State.OBSERVED).all()
    assert float((found.points.double() - walk()[:20]).norm(dim=-1).max()) < 4
    assert found.views[4, 2, 6].item() is False


def test_a_person_who_leaves_is_missing_then(tmp_path):
    values = PIXELS[:20].astype(np.float64)
    values[12:] = np.nan
    predict(
        config(*words(tmp_path, points_file(tmp_path, values)), "formats=[npz]", "fill=100"),
        tmp_path / "out",
    )
    _, found = result(tmp_path)
    assert (found.state[:12] == State.OBSERVED).all()
    assert (found.state[12:] == State.FEW_VIEWS).all()


def test_an_output_that_cannot_be_written_is_named(command, tmp_path):
    (tmp_path / "out").write_text("a file")
    status, _, errors = command(*words(tmp_path, points_file(tmp_path)))
    assert status == 1
    assert "error: output: " in errors


DISK = """
import resource, sys
from pathlib import Path
import ghpt.commands.predict
sys.argv = ["predict.py", *{words!r}]
from ghpt.commands.app import run
resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))
import signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
run(Path({conf!r}), ghpt.commands.predict.COMMAND)
"""


@pytest.mark.posix
@pytest.mark.parametrize(("limit", "file"), [(15_000, "000000.npz"), (25_000, "poses.npz")])
def test_a_full_disk_is_named_and_the_next_run_goes_on(tmp_path, limit, file):
    given = [
        *QUICK,
        *words(tmp_path, points_file(tmp_path)),
        "shard_frames=20",
        "formats=[npz]",
        "overwrite=true",
    ]
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "poses.npz").write_bytes(b"of an earlier run")
    script = DISK.format(words=given, limit=limit, conf=str(CONF))
    ended = children.run("-c", script)
    assert ended.status == 1, ended.errors
    last = ended.errors.strip().splitlines()[-1]
    assert "File too large" in last
    assert file in last
    assert (tmp_path / "out" / "poses.npz").read_bytes() == b"of an earlier run"
    assert not list((tmp_path / "out").rglob("*.tmp"))
    predict(config(*given), tmp_path / "out")
    assert len(result(tmp_path)[1]) == 40


def test_a_recording_of_a_data_set_is_a_demonstration(tmp_path, monkeypatch):
    monkeypatch.setattr(sequences, "recording_sequence", lambda _: sequence_of(30))
    numbers = numbers_of(config("compare=[linear,ransac]", "evaluated_frames=10"), tmp_path / "out")
    assert numbers["source"] == "synthetic"
    assert set(numbers["evaluation"]["estimators"]) >= {"linear", "ransac"}
    for found in numbers["evaluation"]["estimators"].values():
        assert 0 < found["held_out"]["median"] < 5
        assert (
            found["held_out"]["count"]
            == next(iter(numbers["evaluation"]["estimators"].values()))["held_out"]["count"]
        )


@pytest.mark.skipif(not sizes.NIGHTLY, reason="test_commands_agree.py predicts it by day")
def test_a_recording_of_openpose_is_predicted(shared_data, tmp_path):
    """Pose2Sim's demo: figures of docs/recordings.md."""
    one = shared_data / "pose2sim_single"
    numbers = numbers_of(
        config(
            f"keypoints={one / 'pose'}",
            f"cameras={one / 'Calib_qualisys.toml'}",
            "rate_hz=60",
            "evaluated_frames=20",
        ),
        tmp_path / "out",
    )
    assert numbers["frames"] == 100
    assert numbers["share"]["observed"] > 0.95
    assert next(iter(numbers["evaluation"]["estimators"].values()))["held_out"]["median"] < 40


@pytest.mark.skipif(not sizes.NIGHTLY, reason="Pose2Sim's demo is predicted by day")
def test_a_recording_of_mediapipe_is_predicted(shared_data, tmp_path):
    two = shared_data / "caliscope"
    numbers = numbers_of(
        config(f"keypoints={two / 'xy_HOLISTIC.csv'}", f"cameras={two / 'camera_array.toml'}"),
        tmp_path / "two",
    )
    assert numbers["frames"] == 267
    assert 0.8 < numbers["share"]["observed"] < 1
