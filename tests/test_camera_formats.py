"""Cameras in a file of their own each, lenses of every kind, and cameras that lack something."""

import json
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from damage import damage
from ghpt.data.formats.camera_files import read_cameras
from ghpt.data.formats.camera_writers import write_aniposelib, write_opencv, write_pose2sim
from ghpt.data.people.matching import match_views
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import CameraSet
from ghpt.geometry.lens import fisheye_lens, pad_lens
from ghpt.geometry.rotations import matrix_to_quaternion

RIG = human36m_rig("S1")


def opencap(view: int) -> bytes:
    """A camera as OpenCap pickles it: mm, and the image's height before its width."""
    return pickle.dumps(
        {
            "distortion": RIG.distortion[view].numpy()[None],
            "intrinsicMat": RIG.cameras.K[view].numpy(),
            "imageSize": np.array([[1002.0], [1000.0]]),
            "rotation": RIG.cameras.R[view].numpy(),
            "translation": RIG.cameras.t[view].numpy()[:, None],
            "rotation_EulerAngles": np.zeros((3, 1)),
        }
    )


def xrmocap(view: int) -> dict:
    K = np.eye(4)
    K[:3, :3] = RIG.cameras.K[view]
    k1, k2, p1, p2, k3 = RIG.distortion[view].tolist()
    return {
        "class_name": "FisheyeCameraParameter",
        "convention": "opencv",
        "world2cam": True,
        "name": RIG.names[view],
        "width": 1000,
        "height": 1002,
        "intrinsic": K.tolist(),
        "extrinsic_r": RIG.cameras.R[view].tolist(),
        "extrinsic_t": (RIG.cameras.t[view] / 1000).tolist(),
        **{"k1": k1, "k2": k2, "k3": k3, "p1": p1, "p2": p2, "k4": 0.0, "k5": 0.0, "k6": 0.0},
    }


def to_world(view: int) -> dict:
    R, t = RIG.cameras.R[view], RIG.cameras.t[view]
    place = {"extrinsic_r": R.T.tolist(), "extrinsic_t": (-R.T @ t / 1000).tolist()}
    return xrmocap(view) | place | {"world2cam": False}


def nested(view: int) -> dict:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = RIG.cameras.R[view], RIG.cameras.t[view] / 1000
    intrinsics = {"camera_matrix": RIG.cameras.K[view].tolist()}
    lens = {"dist_coeffs": [RIG.distortion[view].tolist()], "image_size": [1000, 1002]}
    return {"intrinsics": intrinsics | lens, "extrinsic": pose.tolist()}


def pinhole(view: int) -> dict:
    """Single numbers, and the camera in the world."""
    (fx, _, cx), (_, fy, cy), _ = RIG.cameras.K[view].tolist()
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = RIG.cameras.R[view], RIG.cameras.t[view] / 1000
    lens = {"coeffs": RIG.distortion[view].tolist(), "width": 1000, "height": 1002}
    intrinsics = {"fx": fx, "fy": fy, "ppx": cx, "ppy": cy} | lens
    return {"color": intrinsics, "camera_to_world": np.linalg.inv(pose).tolist()}


def quaternion(view: int) -> dict:
    (fx, _, cx), (_, fy, cy), _ = RIG.cameras.K[view].tolist()
    return {
        "intrinsics": [fx, fy, cx, cy],
        "distortion_coeffs": RIG.distortion[view].tolist(),
        "resolution": [1000, 1002],
        "qvec": matrix_to_quaternion(RIG.cameras.R[view]).tolist(),
        "tvec": (RIG.cameras.t[view] / 1000).tolist(),
    }


def flat(view: int) -> dict:
    return {
        "K": RIG.cameras.K[view].tolist(),
        "dist": RIG.distortion[view].tolist(),
        "size": [1000, 1002],
        "R": RIG.cameras.R[view].tolist(),
        "t": (RIG.cameras.t[view] / 1000).tolist(),
    }


def check_rig(found: CameraSet, names: tuple[str, ...] = RIG.names) -> None:
    assert found.names == names
    torch.testing.assert_close(found.K, RIG.cameras.K, rtol=0, atol=1e-9)
    torch.testing.assert_close(found.R, RIG.cameras.R, rtol=0, atol=1e-9)
    torch.testing.assert_close(found.t, RIG.cameras.t, rtol=0, atol=1e-6)
    torch.testing.assert_close(found.distortion, RIG.distortion, rtol=0, atol=1e-9)
    assert found.size.tolist() == [[1000, 1002]] * 4


@pytest.mark.parametrize("form", [xrmocap, to_world, nested, pinhole, quaternion])
def test_a_json_file_for_each_camera(form, tmp_path):
    for view, name in enumerate(RIG.names):
        (tmp_path / f"{name}.json").write_text(json.dumps(form(view)))
    check_rig(read_cameras(tmp_path, unit_mm=1000))
    assert not read_cameras(tmp_path).unit_known
    with pytest.raises(GhptDataError, match=rf"holds 1 camera\. .*cameras={tmp_path}"):
        read_cameras(tmp_path / f"{RIG.names[0]}.json")


@pytest.mark.parametrize("form", [nested, pinhole, quaternion, flat])
def test_a_json_file_of_cameras_by_name_or_in_a_list(form, tmp_path):
    cameras = {name: form(view) for view, name in enumerate(RIG.names)}
    (tmp_path / "rig.json").write_text(json.dumps(cameras))
    check_rig(read_cameras(tmp_path / "rig.json", unit_mm=1000))
    check_rig(read_cameras(tmp_path, unit_mm=1000))
    listed = [camera | {"name": name} for name, camera in cameras.items()]
    for content in (listed, {"cameras": listed}):
        (tmp_path / "rig.json").write_text(json.dumps(content))
        check_rig(read_cameras(tmp_path / "rig.json", unit_mm=1000))


def test_a_quaternion_of_an_unknown_order_is_named(tmp_path):
    cameras = {name: flat(view) | {"R": [1, 0, 0, 0]} for view, name in enumerate(RIG.names)}
    (tmp_path / "rig.json").write_text(json.dumps(cameras))
    with pytest.raises(GhptDataError, match=r"rotation: is a quaternion.*qvec"):
        read_cameras(tmp_path / "rig.json")


def test_toml_of_other_fields(tmp_path):
    lines = []
    for view, name in enumerate(RIG.names):
        lines += [f"[{name}]", *(f"{key} = {value}" for key, value in flat(view).items())]
    (tmp_path / "rig.toml").write_text("\n".join(lines))
    check_rig(read_cameras(tmp_path / "rig.toml", unit_mm=1000))


def yml(value: list, columns: int) -> str:
    return f"{{rows: {len(value) // columns}, cols: {columns}, data: {value}}}"


@pytest.mark.parametrize("start", ["%YAML:1.0\n---\n", "distortion_model: plumb_bob\n"])
def test_a_yml_file_for_each_camera(start, tmp_path):
    for view, name in enumerate(RIG.names):
        camera = flat(view)
        fields = {
            "image_width": 1000,
            "image_height": 1002,
            "camera_matrix": yml(np.ravel(camera["K"]).tolist(), 3),
            "distortion_coefficients": yml(camera["dist"], 5),
            "R": yml(np.ravel(camera["R"]).tolist(), 3),
            "T": yml(camera["t"], 1),
        }
        lines = "".join(f"{key}: {value}\n" for key, value in fields.items())
        (tmp_path / f"{name}.yml").write_text(start + lines)
    check_rig(read_cameras(tmp_path, unit_mm=1000))
    path = tmp_path / f"{RIG.names[0]}.yml"
    path.write_text(path.read_text() + "distortion_model: omnidirectional\n")
    says = "there twice" if "model" in start else "distortion_model: is 'omni"
    with pytest.raises(GhptDataError, match=says):
        read_cameras(tmp_path)


def test_opencap_s_pickles_beside_each_other_or_in_folders(tmp_path):
    for view, name in enumerate(RIG.names):
        (tmp_path / "Videos" / name).mkdir(parents=True)
        folder = tmp_path / "Videos" / name
        (folder / "cameraIntrinsicsExtrinsics.pickle").write_bytes(opencap(view))
        (tmp_path / f"{name}_cameraIntrinsicsExtrinsics.pickle").write_bytes(opencap(view))
    check_rig(read_cameras(tmp_path / "Videos"))
    beside = read_cameras(tmp_path)
    check_rig(beside, tuple(f"{name}_cameraIntrinsicsExtrinsics" for name in RIG.names))
    assert match_views("pose", RIG.names, beside, None, None)[0] == [0, 1, 2, 3]


class Evil:
    """A pickle that makes a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self):
        return Path.mkdir, (self.folder,)


def test_a_pickle_runs_nothing(tmp_path):
    made = tmp_path / "made"
    for content in (Evil(made), {"intrinsicMat": Evil(made)}):
        (tmp_path / "camera.pickle").write_bytes(pickle.dumps(content))
        with pytest.raises(GhptDataError, match="is not a pickled camera"):
            read_cameras(tmp_path / "camera.pickle")
    assert not made.exists()


@pytest.mark.parametrize("name", ["camera.pickle", "camera.json"])
def test_a_damaged_file_of_a_camera_is_read_or_named(name, tmp_path):
    (tmp_path / "other.json").write_text(json.dumps(xrmocap(1)))
    (tmp_path / "other.pickle").write_bytes(opencap(1))
    path = tmp_path / name
    path.write_bytes(opencap(0) if path.suffix == ".pickle" else json.dumps(xrmocap(0)).encode())
    (tmp_path / f"other{'.json' if path.suffix == '.pickle' else '.pickle'}").unlink()
    assert damage(path, lambda _: read_cameras(tmp_path), 300) == {"read", "named"}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"convention": "opengl"}, "convention: is 'opengl'.*y down"),
        ({"intrinsic": None}, "cameras: is not a list of cameras"),
        ({"world2cam": "yes"}, "world2cam: is 'yes', not true or false"),
        ({"extrinsic_r": [[1, 0], [0, 1]]}, "rotation: is not 3 or 9 finite numbers"),
    ],
)
def test_a_camera_of_another_kind_is_named(change, says, tmp_path):
    for view, name in enumerate(RIG.names):
        (tmp_path / f"{name}.json").write_text(json.dumps(xrmocap(view) | change))
    with pytest.raises(GhptDataError, match=says):
        read_cameras(tmp_path)


def test_what_a_folder_holds_instead_is_said(tmp_path):
    with pytest.raises(GhptDataError, match="holds no file of cameras: it is empty"):
        read_cameras(tmp_path)
    (tmp_path / "cam1.mp4").touch()
    with pytest.raises(GhptDataError, match=r"holds no file of cameras: cam1\.mp4"):
        read_cameras(tmp_path)
    for name in ("a", "b"):
        write_pose2sim(tmp_path / f"{name}.toml", RIG, {})
    with pytest.raises(GhptDataError, match=r"several files of cameras: a\.toml, b\.toml"):
        read_cameras(tmp_path)
    (tmp_path / "b.toml").unlink()
    assert read_cameras(tmp_path).names == RIG.names


LENSES = torch.stack(
    [
        pad_lens(torch.tensor([0.1, -0.02, 0.001, 0.002])),
        pad_lens(torch.tensor([0.1, -0.02, 0.001, 0.002, 0.01])),
        pad_lens(torch.tensor([0.4, -0.2, 0.001, -0.0005, 0.05, 0.6, -0.1, 0.02])),
        fisheye_lens(torch.tensor([0.02, -0.01, 0.003, -0.001])),
    ]
)


@pytest.mark.parametrize("write", [write_pose2sim, write_aniposelib])
def test_every_lens_comes_back(write, tmp_path):
    rig = CameraSet.from_cameras(RIG.names, RIG.cameras, LENSES, RIG.size)
    write(tmp_path / "rig.toml", rig, {})
    torch.testing.assert_close(read_cameras(tmp_path / "rig.toml").distortion, LENSES)
    with pytest.raises(GhptDataError, match="have a fisheye"):
        write_opencv(tmp_path, rig)
    some = [0, 1, 2]
    write_opencv(tmp_path, rig.select(some))
    torch.testing.assert_close(read_cameras(tmp_path / "intri.yml").distortion, LENSES[some])


def test_coefficients_that_are_zero_may_follow(tmp_path):
    write_pose2sim(tmp_path / "rig.toml", RIG, {})
    text = (tmp_path / "rig.toml").read_text(encoding="utf-8")
    lens = str(RIG.distortion[0].tolist())
    (tmp_path / "rig.toml").write_text(
        text.replace(lens, lens[:-1] + ", 0" * 9 + "]"), encoding="utf-8"
    )
    torch.testing.assert_close(read_cameras(tmp_path / "rig.toml").distortion, RIG.distortion)


def without_pose(path: Path, names: tuple[str, ...]) -> None:
    """Take the extrinsics of some cameras out of a Pose2Sim file."""
    lines, name = [], ""
    for line in path.read_text(encoding="utf-8").splitlines():
        name = line[1:-1] if line.startswith("[") else name
        if name not in names or not line.startswith(("rotation", "translation")):
            lines.append(line)
    path.write_text("\n".join(lines), encoding="utf-8")


def test_a_camera_without_extrinsics_is_left_out_where_two_others_have_them(tmp_path, caplog):
    path = tmp_path / "rig.toml"
    write_pose2sim(path, RIG, {})
    without_pose(path, RIG.names[1:2])
    found = read_cameras(path)
    assert found.unposed == RIG.names[1:2]
    assert not found.calibrated
    at, rig = match_views("pose", RIG.names, found, None, None)
    assert at == [0, 2, 3]
    assert rig.calibrated
    torch.testing.assert_close(rig.cameras.R, RIG.cameras.R[at], rtol=0, atol=1e-9)
    assert RIG.names[1] in caplog.text
    with pytest.raises(GhptDataError, match=f"are not there for {RIG.names[1]}"):
        found.cameras  # noqa: B018
    without_pose(path, RIG.names[:3])
    with pytest.raises(GhptDataError, match=f"are not there for {', '.join(RIG.names[:3])}"):
        read_cameras(path).check_calibrated("pose")


def matched(views: list[str], names: list[str], others: list[str] | None = None) -> list[str]:
    """The camera of each view, by name."""
    count = len(names)
    K, distortion = torch.eye(3).expand(count, 3, 3), torch.zeros(count, 5)
    cameras = CameraSet(tuple(names), K, distortion, other_names=tuple(others or ()))
    at, rig = match_views("pose", views, cameras, None, None)
    return [rig.names[at.index(view)] for view in range(len(views))]


KEYS = ["cam_0", "cam_1", "cam_2"]


@pytest.mark.parametrize(
    ("views", "names", "others", "expected"),
    [
        (["cam01_json", "cam02_json"], ["int_cam01_img", "int_cam02_img"], None, [0, 1]),
        (["hd_00_06", "hd_00_03"], ["01_03", "00_03", "50_01", "00_06"], None, [3, 1]),
        (["int_cam10", "int_cam11"], [f"cam{i:02d}" for i in range(1, 12)], None, [9, 10]),
        (["walk_left", "walk_lower"], ["left", "lower", "right"], None, [0, 1]),
        (["Cam0", "Cam1"], ["Cam0_pickle", "Cam1_pickle"], None, [0, 1]),
        (["cam01_json", "cam02_json"], ["cam01", "cam02", "cam03"], KEYS, [0, 1]),
        (["cam_0", "cam_1"], ["1", "2", "3"], KEYS, [0, 1]),
        (["cam1", "cam2"], ["1", "2", "3"], KEYS, [0, 1]),
        (["cam_0", "cam_1", "cam_2"], ["cam1", "cam2", "cam3"], KEYS, [0, 1, 2]),
        (["a"], ["b", "a"], None, [1]),
    ],
)
def test_names_that_share_words_and_keys(views, names, others, expected):
    assert matched(views, names, others) == [names[camera] for camera in expected]


@pytest.mark.parametrize(
    ("views", "names"),
    [
        (["cam_0", "cam_1"], ["cam_1", "cam_2"]),
        (["front_1", "back_2"], ["1", "2"]),
        (["view1", "view9"], ["cam1", "cam2"]),
    ],
)
def test_a_view_that_no_camera_is_of_is_not_guessed(views, names):
    with pytest.raises(GhptDataError, match="has no camera"):
        matched(views, names)


def test_a_camera_without_a_view_is_left_out_and_named(caplog):
    assert matched(["a", "b"], ["a", "spare", "b"]) == ["a", "b"]
    assert "no view is of it: spare" in caplog.text
