"""Which file is which view and frame: the layouts that people have on their disks."""

import unicodedata
from pathlib import Path, PurePath

import numpy as np
import pytest

from ghpt.data.formats.layout import arrange_frames, arrange_recordings, find_files
from ghpt.errors import GhptDataError

CAMERAS = ("cam01", "cam02", "cam03")
ROOT = Path("pose")


def frames(form: str, session=None, cameras=CAMERAS, numbers=range(20), **other):
    """The frame numbers of each view of files named so."""
    trials = other.get("trials", ("",))
    names = [
        PurePath(form.format(cam=cam, n=n, trial=trial))
        for cam in cameras
        for n in numbers
        for trial in trials
    ]
    views = arrange_frames(ROOT, names, session)
    for view in views:
        assert all(f"{number}" in names[index].stem for number, index in view.files.items())
    return {view.view: list(view.files) for view in views}


def recordings(form: str, session=None, cameras=CAMERAS, trials=("",)):
    """The view and the name of each file that is read."""
    names = [PurePath(form.format(cam=cam, trial=t)) for cam in cameras for t in trials]
    return {view: str(names[i]) for view, i in arrange_recordings(ROOT, names, session)}


@pytest.mark.parametrize(
    "form",
    [
        "{cam}/{cam}_{n:012d}_keypoints.json",
        "{cam}/{n}.json",
        "{cam}/{cam}_{n:012d}_keypoints_2d.json",
        "{cam}/GX010012_{n:012d}.json",
        "{cam}/frame_{n:04d}_rtm17.json",
        "{cam}/{n:04d}_t1.5_halpe26.json",
        "{cam}/predictions/{n:06d}.json",
        "predictions/{cam}/{n:06d}.json",
        "{cam}/{cam}_json/{n:06d}.json",
        "{cam}_{n:012d}_keypoints.json",
        "{n:06d}_{cam}.json",
        "walk_{cam}_{n:06d}_rtm17.json",
        "{cam}_img{n}.json",
    ],
)
def test_views_and_frames_are_told_from_the_names(form):
    found = frames(form)
    assert list(found.values()) == [list(range(20))] * 3
    names = [f"walk_{cam}" if form.startswith("walk") else cam for cam in CAMERAS]
    assert [name.removesuffix("_json") for name in found] == names


def test_the_frame_number_is_the_one_that_changes_even_in_few_frames():
    for numbers in (range(5, 7), [5]):
        found = frames("{cam}/frame_{n:04d}_rtm17.json", numbers=numbers)
        assert found == {cam: list(numbers) for cam in CAMERAS}
    few = frames("{cam}_{n:03d}.json", cameras=(1, 2, 3, 4), numbers=range(3))
    assert few == {view: [0, 1, 2] for view in "1234"}


def test_a_time_beside_the_frame_number_is_no_view():
    names = [PurePath(f"{cam}/{n:04d}_{33 * n + 7}.json") for cam in CAMERAS for n in range(30)]
    found = {view.view: list(view.files) for view in arrange_frames(ROOT, names)}
    assert found == {cam: list(range(30)) for cam in CAMERAS}


def test_names_of_cameras_that_are_not_called_so():
    found = frames("{cam}_{n:04d}.json", cameras=("front_left", "front_right", "back_left"))
    assert list(found) == ["back_left", "front_left", "front_right"]
    assert list(frames("hd_00_{cam:02d}_{n:08d}.json", cameras=(3, 16))) == ["hd_00_03", "hd_00_16"]
    yolo = [
        PurePath(f"predict{i or ''}/labels/{cam}_{n}.txt")
        for i, cam in enumerate(CAMERAS)
        for n in range(1, 9)
    ]
    assert tuple(view.view for view in arrange_frames(ROOT, yolo)) == CAMERAS


@pytest.mark.parametrize(
    "form",
    [
        "{cam}/{trial}_{cam}_{n:012d}_keypoints.json",
        "{trial}/{cam}/{n:06d}.json",
        "{cam}/{trial}/{n:06d}.json",
        "{trial}/pose/{cam}_json/{cam}_{n:06d}.json",
        "{trial}/{cam}_{n:06d}.json",
        "{trial}_{cam}_{n:06d}.json",
    ],
)
def test_one_of_several_sessions_is_chosen(form):
    trials = ("walk", "jump")
    with pytest.raises(
        GhptDataError, match=r"several sessions are in it: jump, walk.*session=jump"
    ):
        frames(form, trials=trials)
    found = frames(form, "walk", trials=trials)
    assert [name.removesuffix("_json") for name in found] == list(CAMERAS)
    assert list(found.values()) == [list(range(20))] * 3
    with pytest.raises(GhptDataError, match="there is no session 'run'"):
        frames(form, "run", trials=trials)


def test_a_session_whose_name_is_a_number_and_one_where_there_is_none():
    assert list(frames("Trial_{trial}/{cam}/{n}.json", "Trial_2", trials=(1, 2))) == list(CAMERAS)
    assert list(frames("{trial}/{cam}/{n}.json", 2, trials=("01", "02"))) == list(CAMERAS)
    with pytest.raises(GhptDataError, match=r"session: there is no session.*It holds one session"):
        frames("{cam}/{n}.json", "walk")


@pytest.mark.parametrize(
    ("form", "read"),
    [
        ("{cam}/alphapose-results.json", "{cam}/alphapose-results.json"),
        ("alphapose-results_{cam}.json", "alphapose-results_{cam}.json"),
        ("{cam}/s1_{cam}_proofread.analysis.h5", "{cam}/s1_{cam}_proofread.analysis.h5"),
        ("{cam}.analysis.h5", "{cam}.analysis.h5"),
        ("{cam}DLC_resnet50_shuffle1_100.csv", "{cam}DLC_resnet50_shuffle1_100.csv"),
    ],
)
def test_a_file_for_each_view(form, read):
    assert recordings(form) == {cam: read.format(cam=cam) for cam in CAMERAS}


@pytest.mark.parametrize(
    ("form", "stages", "read"),
    [
        ("{cam}DLC_resnet50_100{trial}.csv", ("", "_filtered"), "_filtered"),
        ("pose-2d{trial}/{cam}.h5", ("-filtered", ""), "-filtered"),
        ("pose{trial}/{cam}.json", ("", "-associated", "-sync"), "-associated"),
        ("{cam}/s1{trial}.analysis.h5", ("_raw", "_proofread"), "_proofread"),
    ],
)
def test_the_last_stage_of_the_same_results_is_read_and_said(form, stages, read, caplog):
    caplog.set_level("INFO")
    found = recordings(form, trials=stages)
    assert found == {cam: form.format(cam=cam, trial=read) for cam in CAMERAS}
    assert len(caplog.records) == 1


def test_two_files_of_one_view_are_named():
    with pytest.raises(GhptDataError, match=r"cam1DLC_a.csv and cam1DLC_b.csv are both of"):
        recordings("{cam}DLC_{trial}.csv", cameras=("cam1", "cam2"), trials=("a", "b"))
    with pytest.raises(GhptDataError, match=r"2\.json: has the frame number 2, as 02\.json has"):
        arrange_frames(ROOT, [PurePath(f"a/{n}.json") for n in ("1", "02", "2")])


@pytest.mark.parametrize("name", ["cam1/settings.json", "cam1/1234567890123456.json"])
def test_a_name_without_a_frame_number_is_named(name):
    names = [PurePath(name), PurePath("cam1/1.json")]
    with pytest.raises(GhptDataError, match="its name has no frame number"):
        arrange_frames(ROOT, names)


def test_hidden_files_are_no_data_and_a_link_is_followed_once(tmp_path):
    for name in (
        "a/1.json",
        "a/._1.json",
        "a/.DS_Store",
        ".git/2.json",
        "__MACOSX/3.json",
        "b/4.JSON",
    ):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.touch()
    (tmp_path / "b" / "round").symlink_to(tmp_path)
    found = [path.relative_to(tmp_path).as_posix() for path in find_files(tmp_path, (".json",))]
    assert found == ["a/1.json", "b/4.JSON"]


def test_many_files_are_arranged_in_little_time():
    names = [PurePath(f"cam{c}/cam{c}_{n:012d}.json") for c in range(8) for n in range(500)]
    views = arrange_frames(ROOT, names)
    assert [len(view.files) for view in views] == [500] * 8
    np.testing.assert_array_equal(list(views[3].files.values()), np.arange(1500, 2000))


def test_accents_that_macos_stores_apart_are_letters():
    apart = unicodedata.normalize("NFD", "Türseite")
    assert list(frames("{cam}/{n}.json", cameras=(apart, "vorn"))) == ["Türseite", "vorn"]
    assert list(recordings("{cam}.json", cameras=(apart, "vorn"))) == ["Türseite", "vorn"]
