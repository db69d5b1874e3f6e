"""From a detector with feet to files by name: all key points, marker names and a floor."""

import json
import warnings

import numpy as np
import pytest
import torch

from ghpt.commands.predict import predict
from ghpt.config import CONF
from ghpt.data.formats.key_points import write_key_points
from ghpt.data.formats.skeletons import SKELETONS
from ghpt.data.points import KeyPoints
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.errors import GhptConfigError, GhptDataError
from ghpt.export import find_marker_set, read_reconstruction
from ghpt.geometry.cameras import project
from ghpt.reconstruction import State
from ghpt.skeleton import JOINT, JOINTS
from predicting import cameras_file, config, numbers_of, walk
from reconstructions import about, in_parts, random_reconstruction

pytestmark = pytest.mark.usefixtures("blank_figures")

HALPE = SKELETONS["halpe_26"]
FRAMES = 30
HEAD = ("left_eye", "right_eye", "left_ear", "right_ear")


def body(frames: int = FRAMES) -> dict[str, torch.Tensor]:
    """The walk with feet and a face, mm [T, 3] by name."""
    points = walk(frames)
    found = {name: points[:, joint] for name, joint in JOINT.items()}
    found |= {"neck": found["thorax"], "mid_hip": found["pelvis"]}
    for place, name in enumerate(HEAD):
        found[name] = found["nose"] + torch.tensor([20.0 * place - 30, 15, 10 * place])
    for side in ("left", "right"):
        for part, ahead in (("heel", -50.0), ("big_toe", 150.0), ("small_toe", 130.0)):
            offset = torch.tensor([ahead, 30.0 * (part == "small_toe"), -70.0])
            found[f"{side}_{part}"] = found[f"{side}_ankle"] + offset
    return found


def recording(folder, names=HALPE, valid=None):
    """Key points of a detector in Human3.6M's cameras, as our npz."""
    points = torch.stack([body()[name] for name in names], dim=1)
    pixels = project(human36m_rig("S9").cameras, points)[0].numpy()
    valid = np.ones(pixels.shape[:3], bool) if valid is None else valid
    views = [f"cam_{view:02d}" for view in range(4)]
    key_points = KeyPoints(pixels, valid.astype(float), valid)
    path = folder / "points.npz"
    write_key_points(path, views, names, np.arange(FRAMES), key_points, 50.0)
    words = [f"keypoints={path}", f"cameras={cameras_file(folder)}", f"output={folder / 'out'}"]
    return [*words, "estimator=frame"]


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The folder of a prediction for OpenSim, and prediction.json's content."""
    folder = tmp_path_factory.mktemp("feet")
    words = ("markers=pose2sim_halpe26", "world=people", "trc.unit=m")
    numbers = numbers_of(config(*recording(folder), *words), folder / "out")
    return folder / "out", numbers


def test_every_key_point_is_written_by_name_behind_the_17(written):
    about, parts = read_reconstruction(written[0] / "poses.npz")
    assert about.joints == (*JOINTS, *(name for name in HALPE if name not in JOINTS))
    found = next(iter(parts))
    assert (found.state == State.OBSERVED).all()
    change = written[1]["world"]
    R = torch.tensor(change["R"], dtype=torch.float64)
    own = (found.points - torch.tensor(change["t_mm"], dtype=torch.float64)) @ R
    truth = torch.stack([body()[name] for name in about.joints], dim=1).double()
    named = [about.joints.index(name) for name in HALPE]
    assert float((own - truth)[:, named].norm(dim=-1).max()) < 0.1


def test_bones_of_the_feet_are_drawn(written):
    about, _ = read_reconstruction(written[0] / "poses.npz")
    assert ("left_ankle", "left_heel") in about.bones
    assert ("pelvis", "spine") in about.bones


def trc_table(path):
    lines = path.read_text(encoding="utf-8").split("\n")
    names = [name for name in lines[3].split("\t")[2:] if name]
    rows = [[float(cell) for cell in line.split("\t")[2:-1]] for line in lines[6:-1]]
    return lines[2].split("\t")[4], names, np.array(rows).reshape(len(rows), -1, 3)


def test_trc_has_the_model_s_markers_in_metres_with_the_floor_below(written):
    unit, names, points = trc_table(written[0] / "poses.trc")
    assert unit == "m"
    assert set(names) == set(find_marker_set("pose2sim_halpe26").joints)
    heel, head = (points[:, names.index(name), 1] for name in ("LHeel", "Head"))
    assert abs(heel.min()) < 0.03
    assert 1.3 < np.median(head) < 2.0


def test_c3d_has_the_same_markers(written):
    c3d = pytest.importorskip("c3d", reason="c3d reads C3D; it comes with ghpt[test]")
    _, names, points = trc_table(written[0] / "poses.trc")
    with open(written[0] / "poses.c3d", "rb") as handle, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of descriptions, which the format does not require
        reader = c3d.Reader(handle)
        labels = [label.strip() for label in reader.point_labels]
        _, first, _ = next(reader.read_frames())
    assert labels == names
    x, y, z = first[:, :3].T / 1000
    np.testing.assert_allclose(points[0], np.stack([x, z, -y], -1), atol=1e-5)


def test_the_world_is_said_in_every_file(written):
    folder, numbers = written
    about, _ = read_reconstruction(folder / "poses.npz")
    assert about.world == numbers["world"]["axes"]
    assert about.world in (folder / "poses.html").read_text(encoding="utf-8")
    assert about.world.encode() in (folder / "poses.c3d").read_bytes()
    assert json.loads((folder / "prediction.json").read_text())["world"] == numbers["world"]


def test_a_head_needs_no_view_that_sees_all_of_it(tmp_path):
    """Each eye and ear in two views of its own: no view has three of them."""
    names = tuple(name for name in HALPE if name != "head_top")
    valid = np.ones((FRAMES, 4, len(names)), bool)
    for place, name in enumerate(HEAD):
        hidden = [view for view in range(4) if view not in (place, (place + 1) % 4)]
        valid[:, hidden, names.index(name)] = False
    settings = config(*recording(tmp_path, names, valid), "joints=human36m", "formats=[npz]")
    predict(settings, tmp_path / "out")
    about, parts = read_reconstruction(tmp_path / "out" / "poses.npz")
    head = next(iter(parts)).points[:, JOINT["head_top"]]
    truth = torch.stack([body()[name] for name in HEAD]).mean(0).double()
    assert about.joints == JOINTS
    assert float((head - truth).norm(dim=-1).max()) < 0.1


def test_an_animal_is_predicted_by_its_own_names(tmp_path):
    paws = ("snout", "left_paw", "right_paw", "tail")
    parts = ("nose", "left_wrist", "right_wrist", "pelvis")
    words = recording(tmp_path, parts)
    (tmp_path / "mouse.yaml").write_text(f"key_points: [{', '.join(paws)}]\nbones: [[snout, tail]]")
    words.append(f"skeleton={tmp_path / 'mouse.yaml'}")
    numbers = numbers_of(config(*words, "formats=[npz,html]"), tmp_path / "out")
    about, _ = read_reconstruction(tmp_path / "out" / "poses.npz")
    assert about.joints == paws
    assert about.bones == (("snout", "tail"),)
    assert numbers["stature_mm"] is None
    with pytest.raises(GhptDataError, match=r"joints: lack right_ankle"):
        predict(config(*words, "joints=human36m"), tmp_path / "out")


def test_markers_that_the_joints_do_not_give_are_named_and_left_out(caplog):
    made = random_reconstruction(3)
    who = about()
    markers = find_marker_set("pose2sim_halpe26")
    markers.check_joints(who.joints)
    assert "LBigToe" in caplog.text
    renamed, chunks = markers.rename(who, in_parts(made))
    assert "LBigToe" not in renamed.joints
    at = renamed.joints.index("LAnkle")
    assert torch.equal(next(chunks()).points[:, at], made.points[:, JOINT["left_ankle"]])


def test_marker_sets_that_are_none_are_named(tmp_path):
    with pytest.raises(GhptConfigError, match=r"markers: there is no 'pose2sim_halpe'.*halpe26"):
        find_marker_set("pose2sim_halpe")
    (tmp_path / "own.yaml").write_text("LHip: 3")
    with pytest.raises(GhptConfigError, match=r"own\.yaml is no table of marker: joint"):
        find_marker_set(str(tmp_path / "own.yaml"))
    with pytest.raises(GhptConfigError, match="no marker among the joints"):
        find_marker_set("pose2sim_coco17").check_joints(("snout",))


def test_every_marker_is_of_a_joint_that_its_detector_gives():
    known = {*JOINTS, *(name for names in SKELETONS.values() for name in names)}
    for path in (CONF / "marker_sets").glob("*.yaml"):
        assert set(find_marker_set(path.stem).joints.values()) <= known


def test_who_reads_17_joints_with_numpy_finds_them(written):
    with np.load(written[0] / "poses.npz") as arrays:
        assert tuple(arrays["joints"]) == JOINTS
        frames, joints, _ = arrays["points"].shape
        assert joints == len(JOINTS)
        more = len(arrays["more_joints"])
        assert more > 0
        assert arrays["more_points"].shape == (frames, more, 3)
        assert arrays["more_views"].shape[2] == more
