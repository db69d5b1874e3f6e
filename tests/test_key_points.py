"""Our own npz, the matching of views to cameras by name, and what stands between a detector and a
calibration.
"""

import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch

from damage import damage
from ghpt.data.formats.key_points import read_key_points
from ghpt.data.formats.skeletons import SKELETONS
from ghpt.data.people.matching import match_views, normalise_name
from ghpt.data.people.persons import person_sequence
from ghpt.data.people.stored import open_stored
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import CameraSet, project
from ghpt.geometry.lens import distort
from scenes import random_scene
from single_person import SinglePerson, read_person, write_person


def camera_file(names, other=None, lens: float = 0.0) -> CameraSet:
    views = len(names)
    K = torch.tensor([[1000.0, 0, 500], [0, 1000, 500], [0, 0, 1]], dtype=torch.float64).expand(
        views, 3, 3
    )
    distortion = torch.tensor([lens, lens / 2, 0, 0, 0], dtype=torch.float64).expand(views, 5)
    return CameraSet(tuple(names), K, distortion, other_names=tuple(other or ()), path="Calib.toml")


def key_points(views=("a", "b"), frames: int = 5, joints=SKELETONS["coco_17"]) -> SinglePerson:
    rng = np.random.default_rng(0)
    shape = (frames, len(views), len(joints))
    valid = rng.random(shape) < 0.8
    valid[0] = True
    values = np.where(valid[..., None], rng.uniform(0, 1000, (*shape, 2)), 0)
    return SinglePerson(
        "pose",
        tuple(views),
        tuple(joints),
        np.arange(frames) * 2 + 3,
        values,
        np.where(valid, rng.random(shape), 0),
        valid,
        60.0,
    )


def pairs(where, views, cameras, match, wanted) -> list[tuple[int, int]]:
    """The (view, camera) pairs that are matched."""
    at, ordered = match_views(where, views, cameras, match, wanted)
    return list(zip(at, map(cameras.names.index, ordered.names), strict=True))


def test_our_npz_comes_back_as_it_was(tmp_path):
    points = key_points()
    write_person(tmp_path / "points.npz", points)
    found = read_person(tmp_path / "points.npz")
    for name, value in vars(replace(points, path=str(tmp_path / "points.npz"))).items():
        assert np.array_equal(getattr(found, name), value), name
    assert read_person(tmp_path / "points.npz", rate_hz=30).rate_hz == 30


@pytest.mark.parametrize("rate", [0.0, -50.0, np.inf, -np.inf, 1e6, 1e-9])
def test_a_rate_that_no_camera_has_is_refused(rate, tmp_path):
    """In the file, as a setting, and in a file that is read in parts."""
    path = tmp_path / "points.npz"
    write_person(path, key_points())
    with pytest.raises(
        GhptDataError, match=r"points\.npz: rate_hz: is .* frames per second\. Give"
    ):
        read_key_points(path, rate_hz=rate)
    write_person(path, replace(key_points(), rate_hz=rate))
    with pytest.raises(
        GhptDataError, match=r"points\.npz: rate_hz: is .* frames per second\. Give"
    ):
        read_key_points(path)
    with np.load(path) as arrays:
        np.savez(path, **arrays)
    with pytest.raises(
        GhptDataError, match=r"points\.npz: rate_hz: is .* frames per second\. Give"
    ):
        open_stored(path, None, None)
    with pytest.raises(
        GhptDataError, match=r"points\.npz: rate_hz: is .* frames per second\. Give"
    ):
        open_stored(path, None, rate)


def test_a_rate_that_is_not_a_number_is_unknown(tmp_path):
    path = tmp_path / "points.npz"
    write_person(path, replace(key_points(), rate_hz=np.nan))
    assert read_key_points(path).rate_hz is None
    with np.load(path) as arrays:
        np.savez(path, **arrays)
    assert open_stored(path, None, None).rate_hz is None


def test_the_least_npz_is_key_points_views_and_a_skeleton(tmp_path):
    points = key_points()
    values = np.where(points.valid[..., None], points.key_points, np.nan)
    np.savez(
        tmp_path / "p.npz",
        key_points=values,
        views=np.array(["a", "b"]),
        skeleton=np.array("COCO-17"),
    )
    found = read_person(tmp_path / "p.npz")
    np.testing.assert_array_equal(found.valid, points.valid)
    assert np.isfinite(found.key_points).all()
    assert found.joints == SKELETONS["coco_17"]
    assert found.frame.tolist() == [0, 1, 2, 3, 4]
    assert (found.confidence == points.valid).all()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"key_points": None}, "key_points: is missing"),
        ({"views": None}, "views: is missing"),
        ({"views": np.array(["a", "a"])}, "views: names 2 for 2 of key_points, or one twice"),
        ({"views": np.array(["a"])}, "views: names 1 for 2"),
        ({"views": np.array([1, 2])}, "views: is not a list of texts"),
        ({"joints": np.array(["nose"])}, "lack right_ankle|joints: names 1 for 17"),
        (
            {"skeleton": np.array("body_25"), "joints": None},
            "body_25 has 25 joints and the key points have 17",
        ),
        ({"skeleton": np.array("mine"), "joints": None}, "there is no skeleton 'mine'"),
        ({"key_points": np.zeros((5, 2, 17))}, "key_points: has shape 5 x 2 x 17"),
        ({"confidence": np.ones((5, 2, 16))}, "confidence: has shape 5 x 2 x 16"),
        ({"frame": np.array([1, 2, 2, 3, 4])}, "frame: is empty, or does not rise"),
        ({"seen": np.zeros((5, 2, 17), bool)}, "view a: has no key point"),
        ({"views": np.array(["a", None], dtype=object)}, "Python objects"),
    ],
)
def test_a_bad_npz_is_named(change, says, tmp_path):
    points = key_points()
    arrays = {name: np.array(value) for name, value in vars(points).items() if name != "path"}
    arrays = {name: value for name, value in (arrays | change).items() if value is not None}
    np.savez(tmp_path / "p.npz", **arrays)
    with pytest.raises(GhptDataError, match=says):
        read_person(tmp_path / "p.npz")


def test_a_cut_npz_is_named(tmp_path):
    write_person(tmp_path / "p.npz", key_points())
    (tmp_path / "p.npz").write_bytes((tmp_path / "p.npz").read_bytes()[:-30])
    with pytest.raises(GhptDataError, match="not a whole npz"):
        read_person(tmp_path / "p.npz")


@pytest.mark.parametrize(
    ("views", "names", "other", "expected"),
    [
        (["b", "a"], ["a", "b"], None, [(1, 0), (0, 1)]),
        (
            ["cam1_json", "cam2_json", "cam10_json"],
            ["cam01", "cam02", "cam10"],
            None,
            [(0, 0), (1, 1), (2, 2)],
        ),
        (["cam_10", "cam_2"], ["left", "right"], ["cam_2", "cam_10"], [(1, 0), (0, 1)]),
        (["Cam.01", "cam1x"], ["cam1", "cam1x"], None, [(0, 0), (1, 1)]),
        (["cam1", "cam01"], ["cam1", "cam01"], None, [(0, 0), (1, 1)]),
        (["00_05", "00_15"], ["00_15", "00_05"], None, [(1, 0), (0, 1)]),
    ],
)
def test_views_find_their_cameras_by_name(views, names, other, expected):
    assert pairs("pose", views, camera_file(names, other), {}, None) == expected


@pytest.mark.parametrize(
    ("views", "names", "says"),
    [
        (
            ["a", "c"],
            ["a", "b"],
            r"view c has no camera \(views: a, c; cameras of Calib.toml: a, b\)",
        ),
        (["cam_1", "Cam1"], ["cam1", "cam2"], "camera cam1 has more than one view"),
        (["cam1", "x"], ["cam01", "cam001"], "view cam1 has more than one camera"),
    ],
)
def test_what_is_not_one_to_one_is_refused_with_both_sides(views, names, says):
    with pytest.raises(GhptDataError, match=says):
        match_views("pose", views, camera_file(names), {}, None)


def test_the_user_says_which_is_which_and_which_to_use():
    cameras = camera_file(["front", "back", "top"])
    found = pairs("pose", ["1", "2", "top"], cameras, {"1": "back", "2": "front"}, None)
    assert found == [(1, 0), (0, 1), (2, 2)]
    assert pairs("pose", ["front", "top", "x"], cameras, {}, ["top", "front"]) == [(0, 0), (1, 2)]
    for wrong in ({"3": "back"}, {"1": "side"}):
        with pytest.raises(
            GhptDataError, match=r"match says .*, of which one is not there \(views: 1, 2, top;"
        ):
            match_views("pose", ["1", "2", "top"], cameras, wrong, None)
    with pytest.raises(GhptDataError, match="there is no view back with a camera"):
        match_views("pose", ["front", "top"], cameras, {}, ["top", "back"])


def test_zeros_inside_a_number_stay():
    assert normalise_name("cam_100") == "cam100"
    assert normalise_name("cam10") == normalise_name("CAM-010_json") == "cam10"


def test_the_lens_is_undone_before_means_are_taken():
    """A body of 17 exact points through a strong lens: thorax is the mean of the ideal
    shoulders."""
    scene = random_scene(4, frames=1, views=2)
    cameras = camera_file(["a", "b"], lens=-0.2)
    cameras = replace(cameras, K=scene.cameras.K[0])
    pixels, _ = project(scene.cameras, scene.points)
    seen_by_lens = torch.stack(
        [distort(pixels[0, v], cameras.K[v], cameras.distortion[v]) for v in range(2)]
    )
    joints = SKELETONS["coco_17"]
    points = replace(
        key_points(joints=joints, frames=1),
        key_points=seen_by_lens.numpy()[None],
        valid=np.ones((1, 2, 17), bool),
    )
    sequence = person_sequence(points.detections, cameras)
    found = sequence.undistorted()
    mean = pixels[0, :, [joints.index("left_shoulder"), joints.index("right_shoulder")]].mean(1)
    np.testing.assert_allclose(found.pixels[0, :, 8], mean, atol=1e-3)
    assert found.valid.all()
    assert len(sequence) == 1


def test_a_damaged_npz_is_read_or_named(tmp_path):
    """Whatever byte is lost, and wherever the file ends."""
    path = tmp_path / "p.npz"
    write_person(path, key_points(frames=2))
    assert damage(path, read_person, 150) == {"read", "named"}


def test_a_damaged_json_is_read_or_named(tmp_path):
    body = np.concatenate(
        [np.random.default_rng(0).uniform(0, 400, (25, 2)), np.full((25, 1), 0.5)], -1
    )
    for view in ("a", "b"):
        (tmp_path / view).mkdir()
        content = {"people": [{"pose_keypoints_2d": body.ravel().tolist()}]}
        (tmp_path / view / "x_000000000001.json").write_text(json.dumps(content))
    assert damage(
        tmp_path / "a" / "x_000000000001.json", lambda _: read_person(tmp_path, "body_25"), 150
    ) == {
        "read",
        "named",
    }


@pytest.mark.parametrize(
    ("member", "says"),
    [("[Content_Types].xml", "is a spreadsheet"), ("cam1/0.json", "is an archive of files")],
)
def test_an_archive_of_something_else_is_named(member, says, tmp_path):
    with zipfile.ZipFile(tmp_path / "points.zip", "w") as archive:
        archive.writestr(member, "{}")
    with pytest.raises(GhptDataError, match=says):
        read_key_points(tmp_path / "points.zip")
