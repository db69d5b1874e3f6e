import numpy as np
import pytest
import torch

from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import Cameras, CameraSet, project, reprojection_error
from scenes import random_scene


def test_projection_is_the_textbook_formula_one_point_at_a_time():
    scene = random_scene(0, frames=2, views=3)
    pixels, depth = project(scene.cameras, scene.points)
    K, R, t, points = (
        x.numpy() for x in (scene.cameras.K, scene.cameras.R, scene.cameras.t, scene.points)
    )
    for b, v, j in np.ndindex(2, 3, 17):
        u, w, z = K[b, v] @ (R[b, v] @ points[b, j] + t[b, v])
        np.testing.assert_allclose(pixels[b, v, j].numpy(), [u / z, w / z], rtol=1e-12)
        np.testing.assert_allclose(depth[b, v, j].numpy(), z, rtol=1e-12)


def test_a_camera_s_centre_has_depth_0_in_it_and_a_pixel_that_is_no_nan():
    scene = random_scene(1, frames=3, views=4)
    pixels, depth = project(scene.cameras, scene.cameras.centre)
    own = torch.eye(4, dtype=torch.bool)
    assert depth[:, own].abs().max() < 1e-9
    assert not pixels.isnan().any()


def test_pixels_do_not_depend_on_the_unit_or_the_world_frame():
    metres, millimetres = random_scene(2, scale=1e-3), random_scene(2)
    torch.testing.assert_close(metres.key_points, millimetres.key_points, rtol=1e-12, atol=1e-9)
    far = random_scene(2, place=1e6)
    torch.testing.assert_close(far.key_points, millimetres.key_points, rtol=0, atol=1e-6)


def test_reprojection_error_is_0_at_the_truth_and_the_distance_beside_it():
    scene = random_scene(3)
    assert reprojection_error(scene.cameras, scene.key_points, scene.points).max() < 1e-9
    moved = scene.key_points + torch.tensor([3.0, 4.0], dtype=torch.float64)
    error = reprojection_error(scene.cameras, moved, scene.points)
    torch.testing.assert_close(error, torch.full_like(error, 5.0))


def test_reprojection_error_is_inf_behind_a_camera_and_where_an_input_is_not_finite():
    scene = random_scene(4)
    behind = scene.cameras.centre[:, :1] * 2  # the rig looks at the origin
    error = reprojection_error(scene.cameras, scene.key_points[:, :, :1], behind)
    assert torch.isinf(error[:, 0]).all()
    key_points = scene.key_points.clone()
    key_points[0, 1, 2] = torch.nan
    error = reprojection_error(scene.cameras, key_points, scene.points)
    assert torch.isinf(error[0, 1, 2])
    assert torch.isinf(error).sum() == 1


def test_moving_and_indexing_keep_the_cameras():
    cameras = random_scene(5, frames=3).cameras
    assert cameras.to(torch.float32).K.dtype == torch.float32
    torch.testing.assert_close(cameras.index(1).centre, cameras.centre[1])


def test_a_point_in_the_camera_s_plane_has_no_error_but_infinity():
    scene = random_scene(6, frames=1, views=1)
    eye, zero = (
        torch.eye(3, dtype=torch.float64)[None, None],
        torch.zeros(1, 1, 3, dtype=torch.float64),
    )
    cameras = Cameras(scene.cameras.K, eye, zero)
    points = torch.tensor([[[300.0, -200.0, 0.0], [300.0, -200.0, 1e-3]]], dtype=torch.float64)
    error = reprojection_error(cameras, torch.zeros(1, 1, 2, 2), points)
    assert torch.isinf(error[0, 0]).tolist() == [True, False]


def test_reprojection_errors_are_double_whatever_is_given():
    scene = random_scene(7)
    cameras = scene.cameras.to(torch.float32)
    error = reprojection_error(cameras, scene.key_points.float(), scene.points.float())
    assert error.dtype == torch.float64
    assert error.max() < 1e-2


@pytest.mark.parametrize("target", [2, slice(None)])
def test_a_relative_pose_takes_one_camera_s_frame_to_the_others(target):
    scene = random_scene(4, frames=1, views=3)
    rig, points = scene.cameras.index(0), scene.points[0]
    in_camera = points @ rig.R.mT + rig.t[:, None]
    R, t = rig.relative_pose(1, target)
    found = in_camera[1] @ R.mT + t[..., None, :]
    torch.testing.assert_close(found, in_camera[target])


def named_cameras() -> CameraSet:
    rig = random_scene(5, frames=1, views=3).cameras.index(0)
    return CameraSet.from_cameras(("a", "b", "c"), rig, path="rig.toml")


def test_cameras_are_selected_with_all_that_belongs_to_them():
    rig = named_cameras()
    found = rig.select([2, 0])
    assert found.names == ("c", "a")
    assert torch.equal(found.cameras.centre, rig.cameras.centre[[2, 0]])


def test_an_image_size_that_is_not_known_is_twice_the_principal_point():
    rig = named_cameras()
    assert rig.size is None
    assert torch.equal(rig.image_size, (2 * rig.K[:, :2, 2] + 1).round().long())


def test_cameras_without_extrinsics_are_named():
    rig = named_cameras()
    bare = CameraSet(rig.names, rig.K, rig.distortion, path="intrinsics.toml")
    assert not bare.calibrated
    with pytest.raises(GhptDataError, match=r"intrinsics\.toml: rotation, translation"):
        _ = bare.cameras
    with pytest.raises(GhptDataError, match="there is only a"):
        rig.select([0]).check_calibrated("points")
