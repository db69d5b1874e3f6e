"""``python cameras.py``: what it says, what it writes, and how it ends."""

import json

import pytest

from composed import cameras_settings
from ghpt.commands.cameras import CamerasSettings, check_cameras
from ghpt.data.formats.camera_files import read_cameras
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.errors import GhptConfigError, GhptDataError

pytestmark = pytest.mark.usefixtures("little_data")


def settings(*words: str) -> CamerasSettings:
    return cameras_settings("camera_check.frames=24", "camera_check.shift=4", *words)


def test_good_cameras_end_well_and_nothing_is_mended(tmp_path):
    found = check_cameras(settings("data=h36m"), tmp_path)
    assert found.findings == ()
    assert json.loads((tmp_path / "cameras.json").read_text())["findings"] == []
    assert not (tmp_path / "cameras.toml").exists()
    assert "othing" in (tmp_path / "report.md").read_text()
    page = (tmp_path / "report.html").read_text()
    assert 'class="notice good"' in page
    assert page.count("data:image/svg+xml") == 2  # the rig, and the errors over time


def test_a_mistake_is_an_error_and_the_mended_cameras_are_good_again(tmp_path):
    with pytest.raises(GhptDataError, match="rotation_transposed"):
        check_cameras(settings("data=h36m", "spoil=one_rotation_transposed"), tmp_path)
    (finding,) = json.loads((tmp_path / "cameras.json").read_text())["findings"]
    assert finding["code"] == "rotation_transposed"
    good, mended = human36m_rig("S9"), read_cameras(tmp_path / "cameras.toml")
    assert mended.names == good.names
    assert (mended.R - good.cameras.R).abs().max() < 1e-6
    assert (mended.t - good.cameras.t).abs().max() < 1e-2


def test_what_cannot_be_is_named(tmp_path):
    with pytest.raises(GhptConfigError, match="spoil"):
        check_cameras(settings("data=h36m", "spoil=nothing_known"), tmp_path)
    with pytest.raises(GhptDataError, match="missing"):
        check_cameras(
            settings(f"keypoints={tmp_path}/missing", f"cameras={tmp_path}/missing.toml"), tmp_path
        )
