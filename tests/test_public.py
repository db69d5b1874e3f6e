"""The names that `import ghpt` promises, and that asking for them costs nothing before."""

import json
import subprocess
import sys
import time

import numpy as np
import pytest
import torch

import ghpt
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.errors import GhptConfigError, GhptDataError
from ghpt.geometry.cameras import project
from ghpt.geometry.lens import distort
from ghpt.reconstruction import State
from predicting import walk

RIG = human36m_rig("S9")
ARRAYS = (RIG.K.numpy(), RIG.R, RIG.t.float())
TRUTH = walk()[:40].double().numpy()
LIGHT = """
import sys, ghpt
print([name for name in ("torch", "lightning", "hydra", "numpy") if name in sys.modules])
"""


@pytest.fixture
def key_points():
    exact = project(RIG.cameras, torch.from_numpy(TRUTH))[0].numpy()
    return exact + np.random.default_rng(0).normal(0, 0.5, exact.shape)


def test_the_names_are_few_documented_and_there():
    assert len(ghpt.__all__) <= 12
    assert [name for name in ghpt.__all__ if not getattr(ghpt, name).__doc__] == []
    assert set(ghpt.__all__) <= set(dir(ghpt))


def test_a_name_that_is_not_there_is_no_attribute():
    with pytest.raises(AttributeError, match="has no attribute 'triangle'"):
        ghpt.triangle  # noqa: B018  # the access is what is tested


def test_the_import_is_light():
    start = time.process_time()
    child = subprocess.run([sys.executable, "-c", LIGHT], capture_output=True, text=True)
    assert time.process_time() - start < 1
    assert child.stdout.strip() == "[]"


def test_numpy_and_torch_give_the_same(key_points):
    of_numpy = ghpt.triangulate(key_points, ARRAYS)
    of_torch = ghpt.triangulate(torch.from_numpy(key_points), tuple(map(torch.as_tensor, ARRAYS)))
    np.testing.assert_array_equal(of_numpy.points, of_torch.points)
    assert ghpt.mpjpe(of_numpy.points, TRUTH) < 5


def test_a_missing_key_point_costs_its_view_alone(key_points):
    full = ghpt.triangulate(key_points, ARRAYS)
    key_points[3, 1, 5] = np.nan
    poses = ghpt.triangulate(key_points, ARRAYS)
    assert np.linalg.norm(poses.points[3, 5] - TRUTH[3, 5]) < 20
    assert poses.views[3, :, 5].tolist() == [True, False, True, True]
    others = np.ones((40, 17), bool)
    others[3, 5] = False
    np.testing.assert_allclose(poses.points[others], full.points[others], atol=0.1)


def test_a_wrong_key_point_costs_its_view_alone(key_points):
    key_points[4, 2, 7] += 300
    poses = ghpt.triangulate(key_points, ARRAYS)
    assert np.linalg.norm(poses.points[4, 7] - TRUTH[4, 7]) < 20
    assert not poses.views[4, 2, 7]


def test_a_joint_of_one_view_has_no_position_and_says_so(key_points):
    key_points[5, :3, 2] = np.nan
    poses = ghpt.triangulate(key_points, ARRAYS)
    assert np.isnan(poses.points[5, 2]).all()
    assert np.isnan(poses.error[5, 2])
    assert poses.state[5, 2] == State.FEW_VIEWS
    assert np.isfinite(np.delete(poses.points[5], 2, axis=0)).all()


def test_a_key_point_of_no_confidence_is_missing(key_points):
    confidence = np.ones(key_points.shape[:-1])
    confidence[5, :3, 2] = 0
    poses = ghpt.triangulate(key_points, ARRAYS, confidence)
    assert np.isnan(poses.points[5, 2]).all()


def test_the_lens_of_a_camera_set_is_undone(key_points):
    ideal = torch.from_numpy(key_points)
    seen = [distort(ideal[:, v].flatten(0, 1), RIG.K[v], RIG.distortion[v]) for v in range(4)]
    distorted = torch.stack(seen).unflatten(1, (40, 17)).transpose(0, 1)
    through_lens = ghpt.triangulate(distorted, RIG)
    np.testing.assert_allclose(
        through_lens.points, ghpt.triangulate(key_points, ARRAYS).points, atol=1e-4
    )


@pytest.mark.parametrize(
    ("key_points", "cameras", "said"),
    [
        (np.zeros((5, 3, 17, 2)), ARRAYS, r"key_points: has the shape \[5, 3, 17, 2\]"),
        (np.zeros((4, 17, 2)), ARRAYS, r"Give \[T 4 J 2\]"),
        (np.zeros((5, 4, 17, 2)), (ARRAYS[0], ARRAYS[2], ARRAYS[1]), "K, R and t have the shapes"),
    ],
)
def test_shapes_that_do_not_fit_are_named(key_points, cameras, said):
    with pytest.raises(GhptDataError, match=said):
        ghpt.triangulate(key_points, cameras)


def test_a_predictor_takes_arrays_and_changes_of_settings(key_points):
    poses = ghpt.Predictor(estimator="linear", flips=False)(key_points, ARRAYS, rate_hz=50.0)
    assert poses.about.estimator == "linear"
    assert poses.about.rate_hz == 50
    assert ghpt.mpjpe(poses.points, TRUTH) < 5


def test_a_predictor_names_a_setting_that_there_is_not():
    with pytest.raises(GhptConfigError, match="triangulating: no such setting"):
        ghpt.Predictor(triangulating="linear")


@pytest.mark.parametrize("suffix", ["npz", "csv", "trc", "c3d", "html"])
def test_arrays_are_written_in_every_format(tmp_path, suffix):
    points = TRUTH.copy()
    points[3, 5] = np.nan
    ghpt.write_poses(tmp_path / f"walk.{suffix}", points, rate_hz=50)
    assert (tmp_path / f"walk.{suffix}").stat().st_size > 1000


def test_a_page_shows_the_cameras_that_made_the_poses(key_points, tmp_path):
    poses = ghpt.triangulate(key_points, ARRAYS)
    ghpt.write_poses(tmp_path / "walk.html", poses, rate_hz=50)
    page = (tmp_path / "walk.html").read_text(encoding="utf-8")
    data, _ = json.JSONDecoder().raw_decode(page[page.index('{"title"') :])
    assert [camera["name"] for camera in data["cameras"]] == list(poses.about.camera_names)


def test_an_unknown_suffix_is_named(tmp_path):
    with pytest.raises(GhptConfigError, match=r"has the suffix '\.bvh'\. Use \.npz, "):
        ghpt.write_poses(tmp_path / "walk.bvh", TRUTH)


def test_the_metrics_of_arrays():
    moved = TRUTH + np.array([3.0, 4.0, 0.0])
    moved[0, 0] = np.nan
    assert ghpt.mpjpe(moved, TRUTH) == pytest.approx(5)
    assert ghpt.mpjpe(moved, TRUTH, kind="relative") == pytest.approx(0, abs=1e-9)
    assert np.isnan(ghpt.mpjpe(np.full((1, 17, 3), np.nan), TRUTH[:1]))
    errors = ghpt.relative_pose_errors(RIG.R[1:], RIG.t[1:], RIG.R[1:], RIG.t[1:] + 1)
    assert errors.translation_mm == pytest.approx([3**0.5] * 3)
    assert errors.rotation_deg == pytest.approx([0] * 3, abs=1e-6)


def test_a_rig_is_calibrated_from_intrinsics_alone():
    truth = walk()[:80].double()
    noise = np.random.default_rng(1).normal(0, 0.5, (80, 4, 17, 2))
    key_points = project(RIG.cameras, truth)[0].numpy() + noise
    rig, findings = ghpt.calibrate_rig(key_points, RIG.K, height=1750)
    assert rig.names == ("cam_00", "cam_01", "cam_02", "cam_03")
    assert [found.text for found in findings if found.severity == "error"] == []
    R, _ = rig.cameras.relative_pose(0, slice(1, 4))
    true_R, _ = RIG.cameras.relative_pose(0, slice(1, 4))
    zero = np.zeros((3, 3))
    assert ghpt.relative_pose_errors(R, zero, true_R, zero).rotation_deg.max() < 1
    assert [found.code for found in ghpt.check_cameras(key_points, rig)] == []


def test_a_turned_camera_is_found():
    truth = walk()[:80].double()
    key_points = project(RIG.cameras, truth)[0].numpy()
    R = RIG.R.clone()
    R[2] = R[2].T.clone()
    findings = ghpt.check_cameras(key_points, (RIG.K, R, RIG.t))
    assert [found.cameras for found in findings] == [("cam_02",)]
