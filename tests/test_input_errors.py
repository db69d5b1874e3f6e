"""Errors say what was found where something else was wanted, and what to type."""

import json
from pathlib import Path

import pytest
from hydra._internal.utils import get_args_parser

from composed import CONF
from ghpt.api import default_settings
from ghpt.commands.overrides import Source, check_overrides, expand_home, parse_options
from ghpt.config import check_type
from ghpt.data.formats.camera_files import read_cameras
from ghpt.data.formats.camera_writers import write_pose2sim
from ghpt.data.formats.contents import explain_cameras, explain_key_points
from ghpt.data.formats.key_points import read_key_points
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.errors import GhptConfigError, GhptDataError
from ghpt.export import Writer

PERSON = {"version": 1.3, "people": [{"pose_keypoints_2d": [1.0, 2.0, 0.5] * 25}]}


@pytest.fixture
def session(tmp_path: Path) -> Path:
    """A folder of a session: videos, a calibration and key points, each in its own."""
    (tmp_path / "videos").mkdir()
    (tmp_path / "videos" / "cam1.mp4").touch()
    (tmp_path / "frames" / "cam1").mkdir(parents=True)
    (tmp_path / "frames" / "cam1" / "0001.png").touch()
    (tmp_path / "calibration").mkdir()
    write_pose2sim(tmp_path / "calibration" / "Calib.toml", human36m_rig("S1"), {})
    (tmp_path / "pose" / "cam1_json").mkdir(parents=True)
    text = json.dumps(PERSON)
    (tmp_path / "pose" / "cam1_json" / "cam1_000_keypoints.json").write_text(text, "utf-8")
    return tmp_path


def key_points_error(path: Path, cameras: Path | None = None) -> GhptDataError:
    with pytest.raises(GhptDataError) as caught:
        read_key_points(path)
    return explain_key_points(caught.value, path, cameras)


def cameras_error(path: Path, key_points: Path | None = None) -> GhptDataError:
    with pytest.raises(GhptDataError) as caught:
        read_cameras(path)
    return explain_cameras(caught.value, path, key_points)


def test_videos_and_images_are_no_key_points(session):
    error = key_points_error(session / "videos")
    assert error.problem == "holds videos (cam1.mp4), not key points"
    assert "--video cam1.mp4" in error.hint
    assert key_points_error(session / "frames").problem.startswith("holds images (0001.png)")
    assert key_points_error(session / "videos" / "cam1.mp4").problem.startswith("holds videos")
    assert cameras_error(session / "videos").problem == "holds videos (cam1.mp4), not cameras"


def test_exchanged_arguments_are_named(session):
    cameras, pose = session / "calibration" / "Calib.toml", session / "pose"
    exchange = "Exchange keypoints= and cameras=."
    found = key_points_error(cameras, pose)
    assert (found.problem, found.hint) == ("holds cameras (Pose2Sim), not key points", exchange)
    found = cameras_error(pose, cameras)
    assert (found.problem, found.hint) == ("holds key points, not cameras", exchange)
    assert cameras_error(pose, session / "videos").hint == "Name it as keypoints=."


def test_what_is_not_there_is_said_with_what_is(session):
    error = key_points_error(session / "poses")
    assert error.problem == "there is no such file or folder"
    assert error.hint.startswith("Did you mean pose?")
    assert "calibration, frames, pose, videos" in error.hint
    error = cameras_error(session / "calibration" / "Calib.tml")
    assert error.hint.startswith("Did you mean Calib.toml?")


def test_the_folder_below_is_named(session):
    deeper = session / "deep"
    deeper.mkdir()
    (session / "calibration").rename(deeper / "calibration")
    (deeper / "calibration" / "old").mkdir()
    (deeper / "calibration" / "Calib.toml").rename(deeper / "calibration" / "old" / "Calib.toml")
    assert cameras_error(deeper).hint == f"Name the folder below: cameras={deeper / 'calibration'}"


def test_another_error_is_left_as_it_is(session):
    (session / "pose" / "cam1_json" / "cam1_001_keypoints.json").write_text("{", "utf-8")
    problem = key_points_error(session / "pose").problem
    assert problem.startswith("is not valid JSON")
    assert "taken for json" in problem
    (session / "calibration" / "Calib.toml").write_text("[a]\nmatrix = 1", "utf-8")
    assert "a.distortions" in str(cameras_error(session / "calibration"))


PREDICT = Source(CONF, "predict")


@pytest.mark.parametrize(
    ("word", "says"),
    [
        ("rate_hz=59,94", r"rate_hz: has several values \(59,94\).*a point: rate_hz=59\.94"),
        ("formats=trc,c3d", r"'formats=\[trc,c3d\]'.*add -m"),
        ("keypoints", "Write keypoints=VALUE"),
        ("keypoints=a (1)/b", r"Quote the value: \"keypoints='a \(1\)/b'\""),
    ],
)
def test_a_word_that_is_mistyped_is_named(word, says):
    with pytest.raises(GhptConfigError, match=says):
        check_overrides(PREDICT, [word], sweep=False)


def test_several_values_are_a_sweep():
    assert len(check_overrides(PREDICT, ["rate_hz=30,60"], sweep=True)) == 1


@pytest.mark.parametrize("words", [["--keypoints", "pose/"], ["--keypoints=pose/"]])
def test_a_setting_with_dashes_is_named(words):
    with pytest.raises(GhptConfigError, match=r"have no dashes: keypoints=pose/"):
        parse_options(get_args_parser(), words)


def test_the_user_s_folder_is_found(monkeypatch):
    monkeypatch.setenv("HOME", "/home/someone")
    words = ["keypoints=~/pose", "cameras=a~b", "-m", "output=~"]
    expected = ["keypoints=/home/someone/pose", "cameras=a~b", "-m", "output=/home/someone"]
    assert expand_home(words) == expected


def test_one_value_for_a_list_is_named():
    with pytest.raises(GhptConfigError, match=r"not a list .*Give a list: formats=\[trc\]"):
        check_type("trc", list[str] | None, "formats")


def test_a_missing_package_is_said_by_its_own_name():
    writer = Writer("poses.x", print, module="no_such_module", package="some-package")
    with pytest.raises(GhptConfigError, match=r"x needs some-package.*pip install some-package"):
        writer.check_installed("x")
    Writer("poses.x", print, module="json", package="json").check_installed("x")


def test_cameras_without_key_points_are_no_wish_for_synthetic_people():
    with pytest.raises(GhptConfigError, match="keypoints"):
        default_settings(cameras="Calib.toml")
