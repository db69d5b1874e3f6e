"""Cameras as people have them on their disks: read whatever the format, and written so that its own
reader agrees.
"""

import json
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from damage import damage
from ghpt.data.formats.camera_files import read_cameras
from ghpt.data.formats.camera_writers import write_aniposelib, write_opencv, write_pose2sim
from ghpt.data.synthetic.rigs import human36m_rig, panoptic_rig
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import Cameras, CameraSet

META = {"adjusted": False, "error": 0.0, "scale": 'a "height" of 1750 mm'}


def many(count: int = 12, lens: bool = True) -> CameraSet:
    """Random cameras, one turned by almost half a turn, one not at all."""
    rng = np.random.default_rng(3)
    vectors = rng.normal(size=(count, 3))
    vectors[0], vectors[1] = [np.pi - 1e-9, 0, 0], 0
    K = np.broadcast_to(np.eye(3), (count, 3, 3)).copy()
    K[:, 0, 0], K[:, 1, 1], K[:, :2, 2] = (
        rng.uniform(500, 2000, count),
        rng.uniform(500, 2000, count),
        400.123456789,
    )
    names = tuple(f"cam_{i}" for i in range(count))
    cameras = Cameras(
        *map(
            torch.from_numpy,
            (K, Rotation.from_rotvec(vectors).as_matrix(), rng.normal(size=(count, 3)) * 3e3),
        )
    )
    distortion = torch.from_numpy(rng.normal(size=(count, 5)) * 0.1 * lens)
    return CameraSet.from_cameras(
        names, cameras, distortion, torch.tensor([[1080 + i, 1920] for i in range(count)])
    )


WRITERS = {"pose2sim": write_pose2sim, "aniposelib": write_aniposelib, "opencv": None}


def written(form: str, folder: Path, rig: CameraSet) -> Path:
    if form == "opencv":
        write_opencv(folder, rig)
        return folder
    WRITERS[form](folder / "rig.toml", rig, META)
    return folder / "rig.toml"


@pytest.mark.parametrize("form", WRITERS)
@pytest.mark.parametrize(
    "make", [many, lambda: human36m_rig("S1"), lambda: panoptic_rig(range(31))]
)
def test_what_is_written_is_read_back(form, make, tmp_path):
    rig = make()
    found = read_cameras(written(form, tmp_path, rig))
    assert found.names == rig.names
    torch.testing.assert_close(found.K, rig.cameras.K, rtol=0, atol=0)
    torch.testing.assert_close(found.R, rig.cameras.R, rtol=0, atol=1e-9)
    torch.testing.assert_close(found.t, rig.cameras.t, rtol=1e-14, atol=1e-9)
    torch.testing.assert_close(found.distortion, rig.distortion, rtol=0, atol=0)
    assert torch.equal(found.size, rig.size)


def test_opencv_s_own_reader_reads_the_yml(tmp_path):
    rig = many()
    write_opencv(tmp_path, rig)
    intrinsic, extrinsic = (
        cv2.FileStorage(str(tmp_path / f), cv2.FILE_STORAGE_READ)
        for f in ("intri.yml", "extri.yml")
    )
    listed = intrinsic.getNode("names")
    assert [listed.at(i).string() for i in range(listed.size())] == list(rig.names)
    for i, name in enumerate(rig.names):
        np.testing.assert_array_equal(intrinsic.getNode(f"K_{name}").mat(), rig.cameras.K[i])
        np.testing.assert_array_equal(
            intrinsic.getNode(f"dist_{name}").mat(), rig.distortion[i][None]
        )
        assert int(intrinsic.getNode(f"H_{name}").real()) == 1920
        assert int(intrinsic.getNode(f"W_{name}").real()) == 1080 + i
        turned = cv2.Rodrigues(extrinsic.getNode(f"R_{name}").mat())[0]
        np.testing.assert_allclose(turned, rig.cameras.R[i], rtol=0, atol=1e-9)
        np.testing.assert_allclose(
            extrinsic.getNode(f"Rot_{name}").mat(), rig.cameras.R[i], rtol=0, atol=1e-9
        )
        np.testing.assert_allclose(
            extrinsic.getNode(f"T_{name}").mat()[:, 0] * 1000, rig.cameras.t[i], rtol=1e-12
        )


def test_opencv_s_own_writer_is_read(tmp_path):
    rig = many(3)
    for file in ("intri.yml", "extri.yml"):
        store = cv2.FileStorage(str(tmp_path / file), cv2.FILE_STORAGE_WRITE)
        store.startWriteStruct("names", cv2.FileNode_SEQ)
        for name in rig.names:
            store.write("", name)
        store.endWriteStruct()
        for i, name in enumerate(rig.names):
            if file == "intri.yml":
                store.write(f"K_{name}", rig.cameras.K[i].numpy())
                store.write(f"dist_{name}", rig.distortion[i][:, None].numpy())
            else:
                store.write(f"R_{name}", cv2.Rodrigues(rig.cameras.R[i].numpy())[0])
                store.write(f"T_{name}", rig.cameras.t[i][:, None].numpy() / 1000)
        store.release()
    found = read_cameras(tmp_path / "intri.yml")
    assert found.names == rig.names
    assert found.size is None
    torch.testing.assert_close(found.K, rig.cameras.K, rtol=1e-12, atol=0)
    torch.testing.assert_close(found.R, rig.cameras.R, rtol=0, atol=1e-7)
    torch.testing.assert_close(found.t, rig.cameras.t, rtol=1e-12, atol=0)


def test_pose2sim_s_layout(tmp_path):
    """What its retrieve_calib_params looks for, in every table but metadata."""
    rig = many(3, lens=False)
    write_pose2sim(tmp_path / "rig.toml", rig, META)
    tables = tomllib.loads((tmp_path / "rig.toml").read_text())
    assert tables.pop("metadata") == META
    assert list(tables) == list(rig.names)
    for i, table in enumerate(tables.values()):
        assert np.shape(table["matrix"]) == (3, 3)
        assert len(table["distortions"]) == 4
        assert len(table["size"]) == 2
        turned = Rotation.from_rotvec(table["rotation"]).as_matrix()
        np.testing.assert_allclose(turned, rig.cameras.R[i], rtol=0, atol=1e-9)
        np.testing.assert_allclose(
            np.array(table["translation"]) * 1000, rig.cameras.t[i], rtol=1e-12
        )


def test_aniposelib_s_order_of_keys_is_the_rig_s(tmp_path):
    """Its CameraGroup.load takes every table but metadata, sorted by key as text."""
    rig = many(12)
    write_aniposelib(tmp_path / "rig.toml", rig, META)
    tables = tomllib.loads((tmp_path / "rig.toml").read_text())
    loaded = [tables[key] for key in sorted(tables) if key != "metadata"]
    assert [table["name"] for table in loaded] == list(rig.names)
    assert all(len(table["distortions"]) == 5 for table in loaded)


def test_names_of_any_kind_survive_toml(tmp_path):
    rig = many(3)
    rig = CameraSet.from_cameras(
        ("left cam.1", 'the "best"', "Kamera_ä"), rig.cameras, rig.distortion, rig.size
    )
    for form in ("pose2sim", "aniposelib"):
        assert read_cameras(written(form, tmp_path, rig)).names == rig.names


def test_names_that_yml_cannot_tell_apart_are_refused(tmp_path):
    rig = many(2)
    with pytest.raises(GhptDataError, match=r"intri\.yml: names: are the same.*letters, digits"):
        write_opencv(
            tmp_path, CameraSet.from_cameras(("a b", "a.b"), rig.cameras, rig.distortion, rig.size)
        )


CAMERA = """
[{key}]
name = "{key}"
size = [1280, 720]
matrix = [[900.0, 0, 640], [0, 900, 360], [0, 0, 1]]
distortions = [0.1, 0, 0, 0]
rotation = [0, {turn}, 0]
translation = [0, 0, 3]
"""


def toml(folder: Path, text: str | None = None, old: str = "", new: str = "") -> Path:
    text = text or CAMERA.format(key="a", turn=0.5) + CAMERA.format(key="b", turn=1)
    (folder / "c.toml").write_text(text.replace(old, new, 1) if old else text)
    return folder / "c.toml"


def test_a_camera_that_caliscope_ignores_is_left_out(tmp_path):
    text = "".join(CAMERA.format(key=f"cameras.{i}", turn=i) for i in range(3)).replace(
        'name = "cameras.', 'n = "'
    )
    found = read_cameras(
        toml(
            tmp_path, text.replace("[cameras.1]", "[cameras.1]\nignore = true\nrotation_count = -1")
        )
    )
    assert found.format == "caliscope"
    assert found.names == ("cam_0", "cam_2")


def test_intrinsics_alone_are_enough(tmp_path):
    for old, new in (
        ("rotation = [0, 0.5, 0]", ""),
        ("rotation = [0, 0.5, 0]", 'rotation = "null"'),
    ):
        found = read_cameras(toml(tmp_path, old=old, new=new))
        assert not found.calibrated
        assert found.K.shape == (2, 3, 3)
    same = CAMERA.format(key="a", turn=0) + CAMERA.format(key="b", turn=0)
    assert read_cameras(toml(tmp_path, same)).calibrated is False


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (
            "distortions",
            "fisheye = 2\ndistortions",
            r"c\.toml: a\.fisheye: is 2, not true or false",
        ),
        ("distortions", "fisheye = 1.0\ndistortions", r"a\.fisheye: is 1.0, not true or false"),
        (
            "distortions",
            'fisheye = "true"\ndistortions',
            r"a\.fisheye: is 'true', not true or false",
        ),
        ("distortions", 'ignore = "no"\ndistortions', r"a\.ignore: is 'no', not true or false"),
        ('name = "a"', "name = true", r"a\.name: is True, not a name"),
        ('name = "a"', 'name = " "', r"a\.name: is ' ', not a name"),
        ("900.0", "true", "camera a, matrix: is not 9 finite numbers"),
        ("900.0", '"900"', "camera a, matrix: is not 9 finite numbers"),
        ("900.0", "inf", "camera a, matrix: is not 9 finite numbers"),
        ("900.0", "1.1e15", "camera a, matrix: is not 9 finite numbers"),
        (
            "[[900.0, 0, 640], [0, 900, 360], [0, 0, 1]]",
            "[[[[900.0, 0, 640, 0, 900, 360, 0, 0, 1]]]]",
            "a, matrix",
        ),
        (
            "[0.1, 0, 0, 0]",
            "[0.1, true, 0, 0]",
            "camera a, distortion: is not 4, 5, 8, 12 or 14 finite",
        ),
        (
            "[0.1, 0, 0, 0]",
            "[[0.1, 0], [0, 0]]",
            "camera a, distortion: is not 4, 5, 8, 12 or 14 finite",
        ),
        ("[0, 0.5, 0]", "[0, true, 0]", "camera a, rotation: is not 3 or 9 finite numbers"),
        ("[0, 0.5, 0]", '"0 0.5 0"', "camera a, rotation: is not 3 or 9 finite numbers"),
        ("[0, 0, 3]", "[0, true, 3]", "camera a, translation: is not 3 finite numbers"),
        ("[0, 0, 3]", "true", "camera a, translation: is not 3 finite numbers"),
        ("[1280, 720]", "[true, 720]", "camera a, size: is not 2 finite numbers"),
        ("matrix", "matrices", r"a\.matrix: is missing"),
        ("[0.1, 0, 0, 0]", "[0.1, 0]", "camera a, distortion: is not 4, 5, 8, 12 or 14 finite"),
        (
            "[0.1, 0, 0, 0]",
            "[0.1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0.01, 0]",
            "camera a, distortion: has a coefficient after the first 8 that is not 0",
        ),
        (
            "distortions = [0.1, 0, 0, 0]",
            "fisheye = true\ndistortions = [0.1, 0, 0, 0, 0.1]",
            "camera a, distortion: has a coefficient after the first 4 that is not 0",
        ),
        ("[0.1, 0, 0, 0]", "[nan, 0, 0, 0]", "camera a, distortion: is not 4, 5"),
        (
            "[[900.0, 0, 640], [0, 900, 360], [0, 0, 1]]",
            "[[900.0, 0, 640], [0, 900], [0, 0, 1]]",
            "camera a, matrix",
        ),
        (
            "[[900.0, 0, 640], [0, 900, 360]",
            "[[900.0, 0, 0], [640, 900, 360]",
            "camera a, K.*transposed",
        ),
        ("[[900.0", "[[-900.0", "camera a, K.*must be positive"),
        ("[0, 0.5, 0]", "[[1, 0, 0], [0, 2, 0], [0, 0, 1]]", "camera a, R: R is not a rotation"),
        ("[0, 0, 3]", '["0", "0", "3"]', "camera a, translation: is not 3 finite numbers"),
        ("[1280, 720]", "[0, 720]", "camera a, size: is 0 x 720"),
        ('name = "b"', 'name = "a"', "camera a is listed twice"),
        ("matrix = ", "matrix = [", "not TOML either.*Pose2Sim"),
    ],
)
def test_a_bad_toml_is_named(old, new, says, tmp_path):
    with pytest.raises(GhptDataError, match=says):
        read_cameras(
            toml(tmp_path, old=old, new=new)
            if old != 'name = "b"'
            else toml(
                tmp_path,
                CAMERA.format(key="a", turn=0.5) + CAMERA.format(key="b", turn=1).replace(old, new),
            )
        )


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "holds 0 cameras"),
        (b"hello", "not TOML either"),
        (b"\xff\xfe\x00", "not TOML either"),
        (b"a = " + b"[" * 100_000, "not TOML either"),
        (b'{"cameras": 3}', "is not a list of cameras"),
        (b'{"cameras": [{"type": "hd", "name": "00_00"}]}', "camera 00_00, K: is missing"),
        (b"%YAML:1.0\n---\nnames: [a, b]\n", "K_a: is missing"),
        (b"%YAML:1.0\n---\nnothing: 1\n", "names: is not a list"),
        (b"%YAML:1.0\n---\nnames: [a\n", "is not valid yml"),
        (
            b"%YAML:1.0\n---\nK_a: !!opencv-matrix {rows: 999999999, cols: 3, dt: d, data: [1]}\n",
            "K_a: is no matrix",
        ),
    ],
)
def test_a_bad_file_is_named(content, says, tmp_path):
    (tmp_path / "cameras").write_bytes(content)
    with pytest.raises(GhptDataError, match=says):
        read_cameras(tmp_path / "cameras")


@pytest.mark.parametrize("field", ["K", "distCoef", "R", "t", "resolution"])
def test_true_in_json_is_no_number(field, tmp_path):
    camera = {
        "type": "hd",
        "K": np.eye(3).tolist(),
        "distCoef": [0.0] * 5,
        "resolution": [1920, 1080],
    }
    cameras = [camera | {"name": i, "R": np.eye(3).tolist(), "t": [[0], [0], [i]]} for i in (3, 4)]
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps({"cameras": cameras}))
    assert read_cameras(path).names == ("3", "4")
    inner = cameras[1][field] = json.loads(json.dumps(cameras[1][field]))
    (inner if isinstance(inner[0], float | int) else inner[0])[0] = True
    path.write_text(json.dumps({"cameras": cameras}))
    with pytest.raises(GhptDataError, match=r"calibration\.json: camera 4, .* finite numbers"):
        read_cameras(path)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("c.json", '{"intrinsics": {"a": {}, "b": {}, "a": {}}}', "'a' is there twice"),
        ("intri.yml", "%YAML:1.0\n---\nK_a: 1\nK_b: 2\nK_a: 3\n", "K_a is there twice"),
        (
            "c.json",
            '{"cameras": [{"name": true, "K": 1, "distCoef": 1}]}',
            "name: is True, not a name",
        ),
        (
            "intri.yml",
            "%YAML:1.0\n---\nnames: [a, b]\nK_a: true\nK_b: true\n",
            "camera a, matrix: is not 9",
        ),
    ],
)
def test_a_name_that_is_there_twice_or_is_none_is_named(name, content, says, tmp_path):
    (tmp_path / name).write_text(content)
    with pytest.raises(GhptDataError, match=says):
        read_cameras(tmp_path / name)


def test_a_camera_whose_flag_is_zero_is_read(tmp_path):
    assert read_cameras(
        toml(tmp_path, old="distortions", new="fisheye = 0\ndistortions")
    ).names == ("a", "b")
    text = toml(tmp_path).read_text().replace("[a]", "[a]\nignore = 1") + CAMERA.format(
        key="c", turn=2
    )
    assert read_cameras(toml(tmp_path, text)).names == ("b", "c")


def test_yml_is_read_without_running_code(tmp_path):
    (tmp_path / "intri.yml").write_text(
        f"%YAML:1.0\n---\nnames: !!python/object/apply:os.mkdir ['{tmp_path}/run']\n"
    )
    with pytest.raises(GhptDataError, match="K_"):
        read_cameras(tmp_path)
    assert not (tmp_path / "run").exists()


def test_the_real_files(shared_data):
    names = ("cam01", "cam02", "cam03", "cam04")
    found = read_cameras(shared_data / "pose2sim_single" / "Calib_qualisys.toml")
    assert (found.format, found.names, found.other_names) == (
        "Pose2Sim",
        names,
        ("cam_1", "cam_2", "cam_3", "cam_4"),
    )
    one, other = (
        read_cameras(shared_data / "caliscope" / f) for f in ("camera_array.toml", "config.toml")
    )
    assert one.names == other.names == ("cam_0", "cam_1", "cam_2", "cam_3")
    torch.testing.assert_close(one.R, other.R, rtol=0, atol=0)
    torch.testing.assert_close(one.t, other.t, rtol=0, atol=0)
    panoptic = read_cameras(
        shared_data / "panoptic" / "160906_band1" / "calibration_160906_band1.json"
    )
    ours = panoptic_rig(range(31))
    assert len(panoptic) == 479 + 31 + 10
    panoptic = panoptic.select([panoptic.names.index(name) for name in ours.names])
    torch.testing.assert_close(panoptic.cameras.centre, ours.cameras.centre, rtol=0, atol=1e-3)


def test_json_with_a_strange_camera_is_named(tmp_path):
    camera = {
        "type": "hd",
        "K": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        "distCoef": [0] * 5,
        "resolution": [1920, 1080],
    }
    cameras = [
        camera | {"name": f"00_0{i}", "R": np.eye(3).tolist(), "t": [[0], [0], [i]]}
        for i in range(2)
    ]
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps({"cameras": cameras}))
    assert read_cameras(path).cameras.t[1].tolist() == [0, 0, 10]
    cameras[1]["K"] = "no"
    path.write_text(json.dumps({"cameras": cameras}))
    with pytest.raises(GhptDataError, match="camera 00_01, matrix: is not 9 finite numbers"):
        read_cameras(path)


@pytest.mark.parametrize(
    ("form", "file"), [("pose2sim", "rig.toml"), ("opencv", "intri.yml"), ("opencv", "extri.yml")]
)
def test_a_damaged_file_is_read_or_named(form, file, tmp_path):
    path = written(form, tmp_path, many(2))
    assert damage(tmp_path / file, lambda _: read_cameras(path), 150) == {"read", "named"}
