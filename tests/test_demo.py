"""The two commands for somebody who has no key points yet: demo and detect."""

import shlex
import sys
from types import ModuleType, SimpleNamespace

import cv2
import numpy as np
import pytest

from composed import compose
from ghpt.commands import demo, detect
from ghpt.commands.calibration.settings import CalibrateSettings
from ghpt.commands.prediction.settings import PredictSettings
from ghpt.config import settings
from ghpt.data.formats.camera_files import read_cameras
from ghpt.data.formats.key_points import read_key_points
from ghpt.errors import GhptConfigError, GhptDataError

SIZE = (64, 48)
RATE = 25.0


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """The folder of a demonstration, and the commands that it gives, which are not run here."""
    folder = tmp_path_factory.mktemp("demo")
    given = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo, "_perform", lambda name, words, _: given.update({name: words}))
        demo.demo(settings(demo.DemoSettings, compose("demo", "seconds=2")), folder)
    return folder, given


def test_a_demonstration_records_files_as_a_user_has_them(shown):
    folder, _ = shown
    people = read_key_points(folder / demo.KEY_POINTS)
    assert len(read_cameras(folder / demo.CAMERAS).names) == 4
    assert people.rate_hz == 50.0


@pytest.mark.parametrize(
    ("name", "kind"), [("calibrate", CalibrateSettings), ("predict", PredictSettings)]
)
def test_a_demonstration_s_commands_can_be_typed(shown, name, kind):
    words = shlex.split(" ".join(shown[1][name]))
    assert settings(kind, compose(name, *words)).keypoints.endswith("key_points.npz")


class Model:
    """Stands in for BlazePose: each landmark is at the middle of the image, none in a black one."""

    def __init__(self, **_):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def process(self, image):
        mark = SimpleNamespace(x=0.5, y=0.5, visibility=0.75)
        marks = SimpleNamespace(landmark=[mark] * 33) if image.mean() > 100 else None
        return SimpleNamespace(pose_landmarks=marks)


def write_video(path, brightness):
    """A video in which each frame is of one brightness."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), RATE, SIZE)
    for value in brightness:
        writer.write(np.full((SIZE[1], SIZE[0], 3), value, np.uint8))
    writer.release()


@pytest.fixture
def videos(tmp_path, monkeypatch):
    """A folder of two videos, and the stand-in for the detector."""
    module = ModuleType("mediapipe.python.solutions.pose")
    module.Pose = Model
    for name in ("mediapipe", "mediapipe.python", "mediapipe.python.solutions"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(detect, "check_installed", lambda *_: None)
    folder = tmp_path / "videos"
    folder.mkdir()
    write_video(folder / "left.avi", [255, 255, 0, 255])
    write_video(folder / "right.avi", [255, 255])
    return folder


def run(videos, output):
    values = compose("detect", "progress_bar=false") | {"videos": videos and str(videos)}
    output.mkdir(exist_ok=True)
    return detect.detect(settings(detect.DetectSettings, values), output)


def test_videos_become_a_file_of_all_views(videos, tmp_path):
    found = run(videos, tmp_path / "pose")
    with np.load(found.path) as arrays:
        points, confidence = arrays["key_points"], arrays["confidence"]
        assert arrays["views"].tolist() == ["left", "right"]
        assert arrays["rate_hz"] == RATE
    there = np.array([[True, True], [True, True], [False, False], [True, False]])
    assert (np.isfinite(points).all((-1, -2)) == there).all()
    assert (points[there] == (SIZE[0] / 2, SIZE[1] / 2)).all()
    assert (confidence[there] == 0.75).all()


def test_what_is_written_is_read_with_mediapipe_s_joints(videos, tmp_path):
    people = read_key_points(run(videos, tmp_path / "pose").path)
    assert people.rate_hz == RATE


def test_a_video_that_is_none_or_shows_nobody_is_named(videos, tmp_path):
    write_video(videos / "right.avi", [0, 0])
    with pytest.raises(GhptDataError) as nobody:
        run(videos, tmp_path / "pose")
    assert nobody.value.where.endswith("right.avi")
    (videos / "right.avi").write_text("no video")
    with pytest.raises(GhptDataError) as broken:
        run(videos, tmp_path / "pose")
    assert broken.value.where.endswith("right.avi")


@pytest.mark.parametrize("folder", [None, "nowhere", "."])
def test_missing_videos_are_an_error(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(GhptConfigError) as caught:
        run(folder, tmp_path / "pose")
    assert caught.value.key == "videos"
