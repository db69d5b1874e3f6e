"""What predict.py says of its own result: good recordings are good, and each way to spoil one is
said.
"""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra.core.override_parser.overrides_parser import OverridesParser

import sizes
from composed import cameras_settings, compose
from ghpt.calibration.check.units import unit_for, unit_of
from ghpt.calibration.findings import Finding, Severity
from ghpt.commands.cameras import CamerasSettings, check_cameras
from ghpt.commands.prediction.next_commands import commands_on, setting
from ghpt.commands.prediction.verdict import Commands, Judge, Level, Measures
from ghpt.config import build
from ghpt.data.formats.camera_files import read_cameras
from ghpt.data.formats.camera_writers import write_aniposelib, write_pose2sim
from ghpt.data.people.persons import person_sequence
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.errors import GhptConfigError, GhptDataError
from ghpt.export import read_reconstruction
from ghpt.geometry.cameras import Cameras, CameraSet, project
from ghpt.skeleton import JOINT, JOINTS
from predicting import cameras_file, config, numbers_of, walk
from single_person import SinglePerson, write_person

pytestmark = pytest.mark.usefixtures("blank_figures")

RIG = human36m_rig("S9")
QUICKLY = (
    "camera_check.clean=0.004",
    "evaluated_frames=40",
    "fitted_frames=40",
    "camera_check.frames=24",
    "camera_check.shift=2",
    "formats=[npz]",
    f"estimator={'trajectory' if sizes.NIGHTLY else 'frame'}",
)
"""By day each frame is estimated alone, which is quicker; a good recording has its trajectory."""
SHIFTED = "camera_check.shift=12"
"""Where a view is late: that more shifts are tried costs a second."""
NAMES = tuple(f"cam_{i:02d}" for i in range(4))


@cache
def pixels(noise: float = 4.0) -> np.ndarray:
    """The walk as a detector finds it: [T, V, J, 2], with noise in pixels."""
    exact = project(RIG.cameras, walk()[:160])[0].numpy()
    return exact + noise * np.random.default_rng(0).standard_normal(exact.shape)


def points_file(path: Path, values: np.ndarray, joints: list[int] | None = None) -> Path:
    """Key points as ghpt's own npz; of these joints alone, the others unseen."""
    valid = np.isfinite(values).all(-1)
    if joints is not None:
        valid &= np.isin(np.arange(values.shape[2]), joints)
    values = np.where(valid[..., None], values, 0.0)
    names = NAMES[: values.shape[1]]
    frame = np.arange(len(values))
    points = SinglePerson("", names, JOINTS, frame, values, valid.astype(float), valid, 50.0)
    write_person(path, points)
    return path


def rig_file(path: Path, unit_mm: float, write=write_aniposelib) -> Path:
    """The rig with a translation in this unit, in a format whose writer takes mm and writes
    metres."""
    cameras = Cameras(RIG.cameras.K, RIG.cameras.R, RIG.cameras.t * 1000 / unit_mm)
    write(path, CameraSet.from_cameras(NAMES, cameras, 0 * RIG.distortion, RIG.size), {})
    if write is write_aniposelib:  # which writes no such line itself, and says no unit
        path.write_text(
            path.read_text(encoding="utf-8").replace("fisheye = false\n", ""), encoding="utf-8"
        )
    return path


def judged(
    folder: Path, values: np.ndarray, cameras: Path | None = None, *more: str, joints=None
) -> dict:
    """What predict.py makes of these key points."""
    points = points_file(folder / "points.npz", values, joints)
    words = [f"keypoints={points}", f"cameras={cameras or cameras_file(folder)}"]
    return numbers_of(config(*QUICKLY, *words, *more), folder / "out")


def codes(numbers: dict) -> list[str]:
    return [finding["code"] for finding in numbers["verdict"]["findings"]]


def late(values: np.ndarray, view: int, by: int) -> np.ndarray:
    """A view whose frame n + by shows what the others' frame n shows."""
    moved = values.copy()
    moved[by:, view] = values[:-by, view]
    moved[:by, view] = np.nan
    return moved


def half_rate(values: np.ndarray, view: int) -> np.ndarray:
    """A view that has every second frame, numbered without gaps."""
    thinned = values.copy()
    count = (len(values) + 1) // 2
    thinned[:count, view] = values[::2, view]
    thinned[count:, view] = np.nan
    return thinned


def test_a_good_recording_is_good(tmp_path):
    numbers = judged(tmp_path, pixels(), None, "strict=true", "estimator=trajectory")
    assert numbers["verdict"] == {"level": "good", "findings": [], "undecidable": []}
    assert (
        json.loads((tmp_path / "out" / "prediction.json").read_text())["verdict"]
        == numbers["verdict"]
    )
    assert "**good**" in (tmp_path / "out" / "report.md").read_text()


@pytest.mark.parametrize(("frames", "views"), [(20, 4), (160, 2)])
def test_little_to_go_by_is_no_alarm(frames, views, tmp_path):
    used = ",".join(NAMES[:views])
    values = pixels()[:, :views].copy()
    values[frames // 2 :] = np.nan
    numbers = judged(tmp_path, values[:frames], None, f"views=[{used}]")
    assert numbers["verdict"]["level"] == "good"
    assert numbers["completeness"] > 0.9
    assert any("left-out views" in text for text in numbers["verdict"]["undecidable"]) == (
        views == 2
    )


def test_an_upper_body_is_good_and_measured_by_its_arms(tmp_path):
    arms = [JOINT[name] for name in JOINTS if not name.endswith(("hip", "knee", "ankle", "pelvis"))]
    numbers = judged(tmp_path, pixels(2.0), joints=arms)
    assert numbers["verdict"]["level"] == "good"
    assert 1650 < numbers["stature_mm"] < 2000


@pytest.mark.parametrize("unit_mm", sizes.representatives([1000.0], [1.0, 10.0]))
def test_the_person_tells_the_unit_of_a_file_that_does_not_say_it(unit_mm, tmp_path):
    numbers = judged(tmp_path, pixels(), rig_file(tmp_path / "rig.toml", unit_mm))
    assert numbers["unit_mm"] == unit_mm
    assert numbers["verdict"]["level"] == "good"
    about, parts = read_reconstruction(tmp_path / "out" / "poses.npz")
    assert about.provenance["camera_unit_mm"] == unit_mm
    apart = (next(iter(parts)).points.double() - walk()[:160]).norm(dim=-1)
    assert float(apart.nanmedian()) < 30


def test_a_unit_that_fits_nobody_is_asked_for(tmp_path):
    rig = rig_file(tmp_path / "rig.toml", 237.0)
    with pytest.raises(GhptDataError, match=r"unit_mm: the file does not say .* unit_mm=2\d\d"):
        judged(tmp_path, pixels(), rig)
    assert judged(tmp_path, pixels(), rig, "unit_mm=237")["verdict"]["level"] == "good"


def test_a_unit_that_no_limb_tells_is_asked_for(tmp_path):
    trunk = [
        JOINT[name]
        for name in ("left_hip", "right_hip", "left_shoulder", "right_shoulder", "nose", "thorax")
    ]
    with pytest.raises(GhptDataError, match="of whom no limb is seen"):
        judged(tmp_path, pixels(), rig_file(tmp_path / "rig.toml", 1000.0), joints=trunk)


def test_a_stated_unit_that_makes_a_giant_is_not_to_be_used_and_the_command_mends_it(tmp_path):
    rig = rig_file(tmp_path / "rig.toml", 1.0, write_pose2sim)
    assert read_cameras(rig).unit_known
    numbers = judged(tmp_path, pixels(), rig)
    assert numbers["verdict"]["level"] == "do not use"
    finding = numbers["verdict"]["findings"][0]
    assert finding["code"] == "unit"
    assert finding["value"] == 1e-3
    words = shlex.split(finding["command"])
    assert words[:2] == ["python", "predict.py"]
    assert "unit_mm=1" in words
    again = numbers_of(config(*QUICKLY, *words[2:]), tmp_path / "again")
    assert again["verdict"]["level"] == "good"


def test_a_view_that_is_late_is_said_with_a_command_and_strict_fails_after_writing(tmp_path):
    values = late(pixels(), 3, 10)
    with pytest.raises(
        GhptDataError, match=r"verdict: .*cam_03 is \S+ frames late.* Next: python predict\.py"
    ):
        judged(tmp_path, values, None, "strict=true", SHIFTED)
    numbers = json.loads((tmp_path / "out" / "prediction.json").read_text())
    assert codes(numbers) == ["out_of_sync"]
    assert numbers["verdict"]["findings"][0]["value"] == pytest.approx(10, abs=0.2)
    assert (tmp_path / "out" / "poses.npz").exists()


def test_most_views_out_of_time_are_not_to_be_used(tmp_path):
    spoilt = late(late(late(pixels(), 1, 12), 2, 25), 3, 40)
    numbers = judged(tmp_path, spoilt, None, "estimator=trajectory")
    assert numbers["verdict"]["level"] == "do not use"
    assert "left_out_error" in codes(numbers)


def check_settings(points: Path, cameras: Path) -> CamerasSettings:
    quick = ("camera_check.frames=24", SHIFTED)
    return cameras_settings(f"keypoints={points}", f"cameras={cameras}", *quick)


def test_another_frame_rate_is_named_by_both_commands_and_matched_by_time(tmp_path):
    numbers = judged(tmp_path, half_rate(pixels(), 2), None, SHIFTED)
    assert codes(numbers) == ["frame_rate"]
    assert numbers["verdict"]["findings"][0]["value"] == 0.5
    assert "cam_02" in numbers["verdict"]["findings"][0]["text"]
    checked = tmp_path / "checked"
    checked.mkdir()
    with pytest.raises(GhptDataError, match="cam_02: frame_rate"):
        check_cameras(check_settings(tmp_path / "points.npz", cameras_file(tmp_path)), checked)
    words = [f"keypoints={checked / 'keypoints.npz'}", f"cameras={checked / 'cameras.toml'}"]
    assert numbers_of(config(*QUICKLY, *words), tmp_path / "again")["verdict"]["level"] == "good"


SIZE = RIG.size.numpy()[:, None]
SCALES = {"0 and 1": pixels() / SIZE, "-1 and 1": 2 * pixels() / SIZE - 1}


@pytest.mark.parametrize("bounds", SCALES)
def test_normalised_key_points_are_an_error_in_every_command(bounds, tmp_path):
    points = points_file(tmp_path / "points.npz", SCALES[bounds])
    cameras = cameras_file(tmp_path)
    with pytest.raises(GhptDataError, match=f"between {bounds} in an image of 1000 x 100"):
        judged(tmp_path, SCALES[bounds])
    with pytest.raises(GhptDataError, match="normalised"):
        check_cameras(check_settings(points, cameras), tmp_path)
    assert not list((tmp_path / "out").glob("poses.*"))


def test_without_an_image_size_twice_the_principal_point_is_one(tmp_path):
    values = SCALES["0 and 1"]
    cameras = read_cameras(cameras_file(tmp_path))
    points = SinglePerson(
        "",
        NAMES,
        JOINTS,
        np.arange(len(values)),
        values,
        np.ones(values.shape[:-1]),
        np.ones(values.shape[:-1], bool),
        50.0,
    )
    with pytest.raises(GhptDataError, match="normalised"):
        person_sequence(points.detections, replace(cameras, size=None))


def test_images_that_are_turned_are_named(tmp_path):
    wide = Cameras(RIG.cameras.K, RIG.cameras.R, RIG.cameras.t)
    K = wide.K.clone()
    K[:, 0, 2] += 600
    size = RIG.size + torch.tensor([1200, 0])
    write_pose2sim(
        tmp_path / "wide.toml",
        CameraSet.from_cameras(NAMES, Cameras(K, wide.R, wide.t), 0 * RIG.distortion, size),
        {},
    )
    values = (pixels() + np.array([600.0, 0.0]))[..., ::-1]
    with pytest.raises(GhptDataError, match="turned by 90 degrees"):
        judged(tmp_path, values, tmp_path / "wide.toml")


def judge() -> Judge:
    return build(compose("predict")["verdict"], "verdict")


def said(
    height: float | None = 1730.0,
    error: float = 0.01,
    rejected: float = 0.0,
    unit_mm: float = 1000.0,
    observed: float = 1.0,
):
    measures = Measures(height, error, dict.fromkeys(NAMES, error), rejected, observed)
    commands = Commands("cameras", "calibrate", lambda **more: f"predict {more}")
    return judge()(measures, (), unit_mm, commands)


@pytest.mark.parametrize(
    ("height", "level"),
    [
        (1100.0, Level.GOOD),
        (2150.0, Level.GOOD),
        (850.0, Level.LOOK),
        (2500.0, Level.LOOK),
        (173.0, Level.DO_NOT_USE),
        (17300.0, Level.DO_NOT_USE),
        (1.66e6, Level.DO_NOT_USE),
        (1.73, Level.DO_NOT_USE),
        (None, Level.GOOD),
    ],
)
def test_the_size_of_the_person_decides(height, level):
    assert said(height).level == level


def test_left_out_errors_and_rejected_joints_decide():
    assert [said(error=error).level for error in (0.02, 0.04, 0.08)] == [
        Level.GOOD,
        Level.LOOK,
        Level.DO_NOT_USE,
    ]
    assert [said(rejected=part).level for part in (0.01, 0.1, 0.5)] == [
        Level.GOOD,
        Level.LOOK,
        Level.DO_NOT_USE,
    ]
    assert [said(observed=part).level for part in (0.6, 0.4)] == [Level.GOOD, Level.LOOK]


def test_a_recording_with_hardly_any_key_points_is_not_good(tmp_path):
    values = pixels(2.0).copy()
    values[np.random.default_rng(0).random(values.shape[:-1]) > 0.1] = np.nan
    numbers = judged(tmp_path, values)
    assert codes(numbers)[-1] == "little_observed"
    assert 0 < numbers["completeness"] < 0.1


def test_a_unit_is_suggested_in_which_the_person_is_one():
    assert said(1.66e6).findings[0].command == "predict {'unit_mm': 1.0}"
    assert [unit_for(height) for height in (1.7, 170.0, 1700.0, 67.0)] == [1000.0, 10.0, 1.0, 25.4]
    assert 1100 < 4.2 * unit_for(4.2) < 2300
    assert [unit_of(height) for height in (1.7, 170.0, 1700.0, 17.0)] == [1000.0, 10.0, 1.0, None]


@pytest.mark.parametrize(
    ("suspects", "command"),
    [(1, f"predict {{'views': {list(NAMES[1:])}}}"), (2, "calibrate")],
)
def test_cameras_are_left_out_where_more_stay(suspects, command):
    mistake = Finding("moved", Severity.WARNING, "is off", NAMES[:suspects])
    measures = Measures(1730.0, 0.01, dict.fromkeys(NAMES, 0.01), 0.0, 1.0)
    commands = Commands("cameras", "calibrate", lambda **more: f"predict {more}")
    assert judge()(measures, [mistake], 1000.0, commands).findings[0].command == command


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("views", ["cam01", "54138969", "c 1", 'a"b']),
        ("match", {"front json": "cam01"}),
        ("keypoints", "/a b/c,d/(e)"),
        ("person", 2),
        ("unit_mm", 25.4),
        ("cameras", "Calib.toml"),
    ],
)
def test_a_setting_comes_back_through_the_shell_and_hydra(key, value):
    (word,) = shlex.split(setting(key, value))
    override = OverridesParser.create().parse_override(word)
    assert override.key_or_group == key
    found = override.value()
    if isinstance(found, list):
        found = [str(one) for one in found]
    if isinstance(found, dict):
        found = {str(name): str(of) for name, of in found.items()}
    assert (str(found) if isinstance(value, str) else found) == value


def test_commands_hold_what_was_given(tmp_path):
    given = config(
        "keypoints=/my data/pose",
        "cameras=Calib.toml",
        "views=[a,b]",
        "person=1",
        "skeleton=coco_17",
    )
    commands = commands_on(given, given.non_defaults(), tmp_path / "out")
    assert shlex.split(commands.predict(unit_mm=1.0))[2:] == [
        "keypoints='/my data/pose'",
        "cameras=Calib.toml",
        "views=[a,b]",
        "skeleton=coco_17",
        "person=1",
        "unit_mm=1",
        f"output={tmp_path / 'out'}_again",
    ]
    assert "person" not in commands.cameras
    assert "scale.height=1750" in commands.calibrate


def test_bad_settings_of_the_judge_are_named():
    with pytest.raises(GhptConfigError, match="wrong"):
        Judge(**{**vars(judge()), "wrong": 0.001})
