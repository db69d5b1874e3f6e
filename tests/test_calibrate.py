"""calibrate.py as a user meets it: what it writes and says, with and without a scale, and how it
fails.
"""

import json
import re
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from blank import blank_figures
from composed import calibrate_settings, cameras_settings
from ghpt.calibration.comparison import rig_difference
from ghpt.calibration.findings import Severity
from ghpt.commands.calibrate import COMMAND, calibrate, files
from ghpt.commands.calibration.case import people_findings
from ghpt.commands.cameras import check_cameras
from ghpt.commands.outputs import OutputFolder
from ghpt.data.formats.camera_files import read_cameras
from ghpt.data.formats.camera_writers import write_pose2sim
from ghpt.data.synthetic.recordings import draw_motion
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.geometry.cameras import project
from ghpt.geometry.lens import distort
from ghpt.skeleton import JOINT, JOINTS
from predicting import config, numbers_of
from single_person import SinglePerson, write_person

ROOT = Path(__file__).resolve().parents[1]
QUICK_CHECK = ("camera_check.frames=16", "camera_check.shift=2")
"""The check of the file's own extrinsics, which tests/test_camera_check.py tests, made small."""
OUTPUTS = {
    "calibration.json",
    "report.html",
    "report.md",
    "rig.png",
    "rig.svg",
    "rig.toml",
    "rig_anipose.toml",
    "intri.yml",
    "extri.yml",
    "poses.npz",
}


@pytest.fixture
def command(monkeypatch, typed, blank_figures):
    """``command(*words)`` runs calibrate.py in this process: (exit status, stdout, stderr)."""
    monkeypatch.setenv("COLUMNS", "120")
    return lambda *words: typed(ROOT / "conf", COMMAND, words)


@pytest.fixture(scope="module")
def scene():
    """A walking person before Human3.6M's cameras, through their lenses, with 2 px of noise; the
    truth with it.
    """
    rig = human36m_rig("S9")
    truth = draw_motion(0, "S9", "S9/Walking-1", "Walking", 400, 50.0)[::5]
    pixels, _ = project(rig.cameras, torch.from_numpy(truth).double())
    seen_by_lens = distort(pixels.transpose(0, 1).flatten(1, 2), rig.cameras.K, rig.distortion)
    values = seen_by_lens.unflatten(1, truth.shape[:2]).transpose(0, 1).numpy()
    values = values + np.random.default_rng(0).normal(0, 2, values.shape)
    shape = values.shape[:-1]
    points = SinglePerson(
        "",
        tuple(f"cam{i}_json" for i in range(4)),
        JOINTS,
        np.arange(len(truth)),
        values,
        np.ones(shape),
        np.ones(shape, bool),
        10.0,
    )
    return replace(rig, names=tuple(f"cam_{i:02d}" for i in range(len(rig)))), points, truth


def write(folder, scene, extrinsics: bool = True):
    rig, points, _ = scene
    if not extrinsics:
        R, t = rig.cameras.R[:1].expand(4, 3, 3), rig.cameras.t[:1].expand(4, 3)
        rig = replace(rig, R=R, t=t)
    write_pose2sim(folder / "cameras.toml", rig, {})
    write_person(folder / "points.npz", points)
    return (
        f"keypoints={folder / 'points.npz'}",
        f"cameras={folder / 'cameras.toml'}",
        f"output={folder / 'rig'}",
        "evaluated_frames=20",
        *QUICK_CHECK,
    )


@pytest.fixture(scope="module")
def earlier_run(scene, tmp_path_factory):
    """A folder with a scene and the rig that calibrate.py has made of it."""
    folder = tmp_path_factory.mktemp("earlier")
    words = write(folder, scene)
    settings = calibrate_settings(*words)
    with blank_figures(), OutputFolder(folder / "rig", files(settings)):
        calibrate(settings, folder / "rig")
    return folder


@pytest.fixture
def after_a_run(earlier_run, tmp_path):
    """The same in a folder of the test's own, as a command finds it."""
    shutil.copytree(earlier_run, tmp_path, dirs_exist_ok=True)
    return tmp_path


def test_intrinsics_and_a_limb_give_the_rig_in_every_format(typed, scene, earlier_run, tmp_path):
    rig, _, truth = scene
    thigh = float(
        np.median(
            np.linalg.norm(truth[:, JOINT["left_hip"]] - truth[:, JOINT["left_knee"]], axis=-1)
        )
    )
    words = write(tmp_path, scene, extrinsics=False)
    words = (*words, f"scale.segments={{left_thigh: {thigh}}}")
    status, said, errors = typed(ROOT / "conf", COMMAND, words)
    assert status == 0, errors
    output = tmp_path / "rig"
    assert {file.name for file in output.iterdir()} >= OUTPUTS
    found = read_cameras(output / "rig.toml")
    apart = rig_difference(found.cameras, rig.cameras)
    assert float(apart.rotation_deg.max()) < 0.3
    assert float(apart.centre_mm.max()) < 30
    assert apart.scale == pytest.approx(1, abs=0.01)
    # the same key points with extrinsics in the file: the same rig, but for the world
    apart = rig_difference(read_cameras(earlier_run / "rig" / "rig.toml").cameras, found.cameras)
    assert float(apart.rotation_deg.max()) < 1e-5
    assert float(apart.centre_mm.max()) < 1e-3
    for name in ("rig_anipose.toml", "intri.yml"):
        same = read_cameras(output / name)
        assert same.names == found.names
        torch.testing.assert_close(same.R, found.R, rtol=0, atol=1e-9)
        torch.testing.assert_close(same.t, found.t, rtol=1e-12, atol=1e-9)
        torch.testing.assert_close(same.distortion, rig.distortion, rtol=0, atol=0)
    numbers = json.loads((output / "calibration.json").read_text())
    assert numbers["reference"] is None
    assert numbers["difference"] is None
    assert numbers["scale"]["from"] == "segments"
    assert 1 < numbers["explains"]["estimated"]["held_out"]["median"] < 5
    assert "scale" in tomllib.loads((output / "rig.toml").read_text())["metadata"]
    assert "cam_00" in said
    # z is up and the floor at 0
    with np.load(output / "poses.npz") as poses:
        points = poses["points"]
        assert poses["joints"].tolist() == list(JOINTS)
        assert np.isfinite(points).all()
        assert np.nanmedian(points[:, JOINT["head_top"], 2]) > 1200
        assert abs(np.nanmedian(points[:, [0, 5], 2].min(1))) < 150
    limb = np.linalg.norm(points[:, JOINT["left_hip"]] - points[:, JOINT["left_knee"]], axis=-1)
    assert np.median(limb) == pytest.approx(thigh, rel=0.02)
    image = cv2.imread(str(output / "rig.png"))
    assert image.shape[0] > 500


def test_a_height_comes_back_from_every_command(command, scene, tmp_path):
    keypoints, *words = write(tmp_path, scene)
    assert command(keypoints, *words, "scale.height=1750")[0] == 0
    again = f"cameras={tmp_path / 'rig' / 'rig.toml'}"
    checked = check_cameras(cameras_settings(keypoints, again, *QUICK_CHECK), tmp_path)
    assert checked.stature_mm == pytest.approx(1750, rel=0.01)
    alone = ("estimator=frame", "formats=[npz]")
    predicted = numbers_of(config(keypoints, again, *alone), tmp_path / "out")
    assert predicted["stature_mm"] == pytest.approx(1750, rel=0.01)


def test_extrinsics_in_the_file_are_compared_with_and_not_used(command, scene, tmp_path):
    rig, _, _ = scene
    words = write(tmp_path, scene)
    status, said, errors = command(*words, "scale.baseline=[cam_00,cam_03,8000]")
    assert status == 0, errors
    numbers = json.loads((tmp_path / "rig" / "calibration.json").read_text())
    assert numbers["reference"] == "the file's own calibration"
    assert max(numbers["difference"]["rotation_deg"].values()) < 0.3
    true = float((rig.cameras.centre[0] - rig.cameras.centre[3]).norm())
    assert numbers["difference"]["scale"] == pytest.approx(true / 8000, rel=0.02)
    centre = np.array([camera["centre_mm"] for camera in numbers["cameras"]])
    assert np.linalg.norm(centre[0] - centre[3]) == pytest.approx(8000, rel=1e-6)
    ours, own = (
        numbers["explains"][n]["held_out"] for n in ("estimated", "the file's own calibration")
    )
    assert ours["count"] == own["count"] > 0
    assert ours["median"] < 1.1 * own["median"]
    assert "Δ rotation" in said


def test_an_assumed_scale_is_said_everywhere(earlier_run):
    for file in ("report.md", "rig.toml", "rig_anipose.toml", "calibration.json"):
        assert "assumed" in (earlier_run / "rig" / file).read_text()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["cameras=null"], "cameras: is missing"),
        (["keypoints=nowhere"], "nowhere: : |there is no such file"),
        (["cameras=nowhere.toml"], "there is no such file"),
        (
            ["scale.height=1750", "scale.baseline=[cam_00,cam_03,8000]"],
            "scale: has height and baseline",
        ),
        (["scale.baseline=[cam_00,cam_00,3000]"], "scale.baseline: is"),
        (["scale.baseline=[cam_00,front,3000]"], "Give two of cam_00"),
        (
            ["scale.segments={tail: 30}"],
            r"scale\.segments: names 'tail', which is no part of the body",
        ),
        (["scale.segments={thigh: long}"], r"scale\.segments: says thigh is 'long'"),
        (["scale.height=-3"], r"scale\.height: is -3"),
        (["estimator=guess"], "estimator: is 'guess'"),
        (["views=[cam_00,cam_07]"], "there is no view cam_07"),
        (["views=[cam_00]"], "triangulation needs at least two|fewer than two|1 given"),
        (["skeleton=body_25"], "body_25 has 25 joints and the key points have 17"),
        (["evaluated_frames=0"], "evaluated_frames"),
    ],
)
def test_bad_input_ends_in_one_line(words, says, command, scene, tmp_path):
    status, _, errors = command(*write(tmp_path, scene), *words)
    assert status == 1
    line = errors.strip().splitlines()[-1]
    assert line.startswith("error: ")
    assert re.search(says, line), line
    assert not any((tmp_path / "rig" / name).exists() for name in OUTPUTS)


def test_a_camera_that_an_error_concerns_is_in_no_file(command, scene, after_a_run):
    """Its key points are another person's: noise."""
    rig, points, _ = scene
    values = points.key_points.copy()
    values[:, 2] = np.random.default_rng(1).uniform(100, 900, values[:, 2].shape)
    words = write(after_a_run, (rig, replace(points, key_points=values), None))
    status, _, errors = command(*words)  # the files of the earlier run must not survive
    assert status == 1
    assert "only cam_00, cam_01, cam_03 are in the rig's files" in errors
    for name in ("rig.toml", "rig_anipose.toml", "intri.yml"):
        assert read_cameras(after_a_run / "rig" / name).names == ("cam_00", "cam_01", "cam_03")
    numbers = json.loads((after_a_run / "rig" / "calibration.json").read_text())
    assert [camera["calibrated"] for camera in numbers["cameras"]] == [True, True, False, True]
    assert numbers["cameras"][2]["R"] is None


def test_without_a_usable_rig_there_is_none(command, scene, after_a_run):
    rig, points, _ = scene
    noise = np.random.default_rng(1).uniform(100, 900, points.key_points.shape)
    words = write(after_a_run, (rig, replace(points, key_points=noise), None))
    status, said, errors = command(*words)
    assert status == 1
    assert "no rig is written" in errors
    left = {file.name for file in (after_a_run / "rig").iterdir()} & OUTPUTS
    assert left <= {"calibration.json", "report.md", "report.html", "rig.png", "rig.svg"}
    assert "error" in said


def test_the_followed_person_is_mentioned(scene):
    one = replace(scene[1], views=("a", "b", "c", "d")).detections
    twice = np.sort(np.r_[np.arange(len(one)), :3])  # the first view's come first
    fields = {name: getattr(one, name)[twice] for name in ("row", "view", "identity", "points")}
    (note,) = people_findings(replace(one, **fields))
    assert note.severity == Severity.WARNING
    assert "3 frames of a;" in note.text
    assert people_findings(one) == ()


def test_the_real_recording_says_what_it_is_worth(command, shared_data, tmp_path):
    folder = shared_data / "pose2sim_single"
    status, _, errors = command(
        f"keypoints={folder / 'pose'}",
        f"cameras={folder / 'Calib_qualisys.toml'}",
        f"output={tmp_path / 'rig'}",
        "scale.height=1750",
        "evaluated_frames=20",
        *QUICK_CHECK,
    )
    assert status == 0, errors
    numbers = json.loads((tmp_path / "rig" / "calibration.json").read_text())
    ours, own = (
        numbers["explains"][n]["held_out"] for n in ("estimated", "the file's own calibration")
    )
    assert ours["count"] == own["count"]
    evidence = numbers["evidence"]
    assert evidence["frames"] == 100
    assert 3 < evidence["independent"] < 15
    assert 15 < evidence["turned_deg"] < 90
    # the file's calibration is about as far from the truth as the estimate
    assert max(numbers["difference"]["rotation_deg"].values()) < 4 * evidence["rotation_sd_deg"]
    assert max(numbers["difference"]["rotation_deg"].values()) < 2
    assert max(numbers["difference"]["centre_mm"].values()) < 80


def test_the_seated_person_is_said_not_to_do(command, shared_data, tmp_path):
    folder = shared_data / "caliscope"
    status, said, _ = command(
        f"keypoints={folder / 'xy_HOLISTIC.csv'}",
        f"cameras={folder / 'camera_array.toml'}",
        f"output={tmp_path / 'rig'}",
        "evaluated_frames=20",
        "calibration.frames=100",
        *QUICK_CHECK,
    )
    numbers = json.loads((tmp_path / "rig" / "calibration.json").read_text())
    assert "little_motion" in {found["code"] for found in numbers["findings"]}
    assert "error (little_motion): " in said
    assert status == 1
    assert not (tmp_path / "rig" / "rig.toml").exists()
