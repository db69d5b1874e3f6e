"""COLMAP's models as its own library writes them, and Human3.6M's camera parameters."""

import json

import numpy as np
import pycolmap
import pytest
import torch

from damage import damage
from ghpt.data.formats.camera_files import read_cameras
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.errors import GhptDataError
from ghpt.geometry.lens import distort

CAMERAS = [
    ("SIMPLE_PINHOLE", [500, 320, 240], [500, 500, 0, 0, 0, 0, 0]),
    ("PINHOLE", [500, 510, 320, 240], [500, 510, 0, 0, 0, 0, 0]),
    ("SIMPLE_RADIAL", [500, 320, 240, 0.1], [500, 500, 0.1, 0, 0, 0, 0]),
    ("RADIAL", [500, 320, 240, 0.1, 0.02], [500, 500, 0.1, 0.02, 0, 0, 0]),
    (
        "OPENCV",
        [500, 510, 320, 240, 0.1, 0.02, 0.003, 0.004],
        [500, 510, 0.1, 0.02, 0.003, 0.004, 0],
    ),
    (
        "FULL_OPENCV",
        [500, 510, 320, 240, 0.1, 0.02, 0.003, 0.004, 0.005, 0, 0, 0],
        [500, 510, 0.1, 0.02, 0.003, 0.004, 0.005],
    ),
]


def model(folder, form="binary", cameras=CAMERAS, name="cam{}.png", points=0):
    """The model, written by COLMAP's library."""
    rng = np.random.default_rng(1)
    scene = pycolmap.Reconstruction()
    for number, (kind, parameters, *_) in enumerate(cameras, start=1):
        camera = pycolmap.Camera(
            model=kind, width=640, height=480, params=parameters, camera_id=number
        )
        scene.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=name.format(number), camera_id=number, image_id=number)
        if points:
            image.points2D = [pycolmap.Point2D(xy) for xy in rng.uniform(0, 400, (points, 2))]
        wxyz = rng.normal(size=4)
        turn = pycolmap.Rotation3d(wxyz / np.linalg.norm(wxyz))
        scene.add_image_with_trivial_frame(image, pycolmap.Rigid3d(turn, rng.normal(size=3)))
    folder.mkdir(exist_ok=True)
    scene.write_binary(folder) if form == "binary" else scene.write_text(folder)
    return scene


@pytest.mark.parametrize("form", ["binary", "text"])
@pytest.mark.parametrize("points", [0, 3])
def test_a_model_is_read_as_its_library_reads_it(form, points, tmp_path):
    scene = model(tmp_path, form, points=points)
    found = read_cameras(tmp_path, unit_mm=250)
    assert (found.format, found.unit_known) == ("COLMAP", True)
    assert found.names == tuple(f"cam{i}" for i in range(1, 7))
    points = np.random.default_rng(0).normal(size=(20, 3))
    for i, (_, _, expected) in enumerate(CAMERAS):
        pose = scene.images[i + 1].cam_from_world().matrix()
        np.testing.assert_allclose(found.R[i], pose[:, :3], atol=1e-12)
        np.testing.assert_allclose(found.t[i], pose[:, 3] * 250, atol=1e-9)
        assert [found.K[i, 0, 0], found.K[i, 1, 1], *found.distortion[i]] == expected
        # half a pixel: its first pixel's centre is at (0.5, 0.5)
        in_camera = points + np.array([0, 0, 10])
        theirs = np.array([scene.cameras[i + 1].img_from_cam(p) for p in in_camera])
        if not any(expected[2:]):
            ours = in_camera @ found.K[i].numpy().T
            np.testing.assert_allclose(ours[:, :2] / ours[:, 2:], theirs - 0.5, atol=1e-9)
    assert found.size.tolist() == [[640, 480]] * 6


def test_a_model_has_no_unit(tmp_path):
    model(tmp_path)
    found = read_cameras(tmp_path)
    assert not found.unit_known
    torch.testing.assert_close(found.t, read_cameras(tmp_path, unit_mm=1000).t)


def test_images_called_alike_are_told_apart_by_their_folders(tmp_path):
    model(tmp_path, name="view{}/0001.png")
    assert read_cameras(tmp_path, unit_mm=1).names == tuple(f"view{i}" for i in range(1, 7))
    model(tmp_path, name="view{}/0001.png", form="text")
    for file in ("images.txt", "images.bin"):
        path = tmp_path / file
        path.write_bytes(path.read_bytes().replace(b"view3", b"view2"))
    with pytest.raises(
        GhptDataError, match=r"with names that tell no cameras apart.*keep one image of each"
    ):
        read_cameras(tmp_path, unit_mm=1)


@pytest.mark.parametrize(
    ("kind", "parameters", "says"),
    [
        ("FOV", [500, 510, 320, 240, 0.1], "is of the model .* with .*undistort the images first"),
    ],
)
@pytest.mark.parametrize("form", ["binary", "text"])
def test_lenses_that_are_not_known_are_named(form, kind, parameters, says, tmp_path):
    model(tmp_path, form, cameras=[*CAMERAS[:2], (kind, parameters)])
    with pytest.raises(GhptDataError, match=f"camera cam3: {says}"):
        read_cameras(tmp_path, unit_mm=1)


@pytest.mark.parametrize("form", ["binary", "text"])
@pytest.mark.parametrize("file", ["cameras", "images"])
def test_a_damaged_model_is_read_or_named(form, file, tmp_path):
    model(tmp_path, form, points=2)
    path = tmp_path / f"{file}.{'bin' if form == 'binary' else 'txt'}"
    assert damage(path, lambda _: read_cameras(tmp_path, unit_mm=1), 150) == {"read", "named"}


LENSES = {
    "OPENCV_FISHEYE": [500, 510, 320, 240, 0.02, -0.01, 0.003, -0.001],
    "SIMPLE_RADIAL_FISHEYE": [500, 320, 240, 0.05],
    "RADIAL_FISHEYE": [500, 320, 240, 0.05, -0.01],
    "FULL_OPENCV": [500, 510, 320, 240, 0.1, 0.02, 0.003, 0.004, 0.005, 0.06, 0.01, 0.002],
}


def test_other_lenses_show_what_the_library_shows(tmp_path):
    scene = model(tmp_path, cameras=list(LENSES.items()))
    found = read_cameras(tmp_path, unit_mm=1)
    in_camera = np.random.default_rng(0).uniform((-1, -1, 3), (1, 1, 5), (20, 3))
    for i in range(len(LENSES)):
        theirs = np.array([scene.cameras[i + 1].img_from_cam(point) for point in in_camera])
        ideal = torch.from_numpy(in_camera / in_camera[:, 2:]) @ found.K[i].T
        ours = distort(ideal[:, :2], found.K[i], found.distortion[i])
        np.testing.assert_allclose(ours, theirs - 0.5, atol=1e-9)


def frames_of_a_rig(folder, name, moved=0.0):
    """Three images of each of two cameras; the last image is ``moved`` away."""
    rng = np.random.default_rng(1)
    scene = pycolmap.Reconstruction()
    for number in (1, 2):
        camera = pycolmap.Camera(
            model="PINHOLE", width=640, height=480, params=[500, 500, 320, 240], camera_id=number
        )
        scene.add_camera_with_trivial_rig(camera)
        wxyz = rng.normal(size=4)
        turn, t = pycolmap.Rotation3d(wxyz / np.linalg.norm(wxyz)), rng.normal(size=3)
        for frame in range(3):
            image = pycolmap.Image(
                name=name.format(number, frame), camera_id=number, image_id=3 * number + frame
            )
            last = (number, frame) == (2, 2)
            scene.add_image_with_trivial_frame(image, pycolmap.Rigid3d(turn, t + last * moved))
    folder.mkdir(exist_ok=True)
    scene.write_binary(folder)


@pytest.mark.parametrize("name", ["cam{}/{:04}.png", "cam{}_{:04}.png", "{1:04}/cam{0}.png"])
def test_images_of_a_camera_that_stands_still_are_one(name, tmp_path):
    frames_of_a_rig(tmp_path, name)
    assert read_cameras(tmp_path, unit_mm=1).names == ("cam1", "cam2")


def test_a_camera_that_moves_is_named(tmp_path):
    frames_of_a_rig(tmp_path, "cam{}/{:04}.png", moved=0.1)
    with pytest.raises(GhptDataError, match=r"are of 3 places with names that tell no cameras"):
        read_cameras(tmp_path, unit_mm=1)


def test_human36m_s_camera_parameters(shared_data, tmp_path):
    path = shared_data / "human36m" / "camera-parameters.json"
    for subject in ("S1", "S9"):
        found, ours = read_cameras(path, subject=subject), human36m_rig(subject)
        assert found.names == ours.names
        for field in ("K", "R", "t"):
            torch.testing.assert_close(
                getattr(found, field), getattr(ours.cameras, field), rtol=1e-9, atol=1e-6
            )
        torch.testing.assert_close(found.distortion, ours.distortion)
    with pytest.raises(GhptDataError, match=r"different for each subject.*S1, S2"):
        read_cameras(path)
    with pytest.raises(GhptDataError, match="there is no 'S20'"):
        read_cameras(path, subject="S20")
    content = json.loads(path.read_text())
    (tmp_path / "c.json").write_text(json.dumps({"intrinsics": content["intrinsics"]}))
    assert read_cameras(tmp_path / "c.json").calibrated is False
    del content["intrinsics"]["54138969"]["distortion"]
    (tmp_path / "c.json").write_text(json.dumps(content))
    with pytest.raises(GhptDataError, match=r"intrinsics\.54138969\.distortion: is missing"):
        read_cameras(tmp_path / "c.json", subject="S1")
