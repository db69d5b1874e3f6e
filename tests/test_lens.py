import json

import cv2
import numpy as np
import pytest
import torch

from ghpt.geometry.lens import distort, fisheye_lens, is_fisheye, undistort

K = np.array([[1100.0, 0, 510], [0, 1120, 495], [0, 0, 1]])
LENSES = [
    (0.0, 0.0, 0.0, 0.0),
    (-0.3, 0.15, 1e-3, -2e-3),
    (-0.2, 0.24, -1.4e-3, -1e-3, -3e-3),
    (0.4, -0.1, 5e-3, 2e-3, 0.05),
    (0.5, -0.3, 1e-3, -1e-3, 0.1, 0.8, -0.2, 0.05),
]


def grid(width=1000, height=1000, count=25):
    axes = np.linspace(0, width - 1, count), np.linspace(0, height - 1, count)
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)


def as_tensors(*arrays):
    return tuple(torch.from_numpy(np.array(a, dtype=np.float64)) for a in arrays)


def opencv_distorted(ideal, K, coefficients):
    rays = np.c_[(ideal - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones(len(ideal))]
    return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, np.array(coefficients))[0][:, 0]


@pytest.mark.parametrize("coefficients", LENSES)
def test_distorting_is_opencv_s(coefficients):
    ours = distort(*as_tensors(grid(), K, coefficients))
    np.testing.assert_allclose(ours, opencv_distorted(grid(), K, coefficients), atol=1e-9)


@pytest.mark.parametrize("coefficients", LENSES)
def test_undistorting_is_opencv_s_and_undoes_distorting(coefficients):
    pixels = grid()
    ideal, exists = undistort(*as_tensors(pixels, K, coefficients))
    assert exists.all()
    np.testing.assert_allclose(distort(ideal, *as_tensors(K, coefficients)), pixels, atol=1e-8)
    accurate = (cv2.TERM_CRITERIA_MAX_ITER + cv2.TERM_CRITERIA_EPS, 500, 1e-12)
    iterate = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)  # one function from OpenCV 5
    theirs = iterate(pixels[:, None], K, np.array(coefficients), R=None, P=K, criteria=accurate)[
        :, 0
    ]
    np.testing.assert_allclose(ideal, theirs, atol=1e-4)


def test_real_cameras_are_undistorted_over_their_whole_images(shared_data):
    panoptic = json.loads(
        (shared_data / "panoptic/160906_band1/calibration_160906_band1.json").read_text()
    )["cameras"]
    cameras = [(c["K"], c["distCoef"], c["resolution"]) for c in panoptic]
    human36m = json.loads((shared_data / "human36m/camera-parameters.json").read_text())[
        "intrinsics"
    ].values()
    cameras += [(c["calibration_matrix"], c["distortion"], (1000, 1002)) for c in human36m]
    matrices, lenses = as_tensors([c[0] for c in cameras], [c[1] for c in cameras])
    pixels = torch.from_numpy(np.stack([grid(*size, count=12) for _, _, size in cameras]))
    ideal, exists = undistort(pixels, matrices, lenses)
    assert exists.all()
    assert (distort(ideal, matrices, lenses) - pixels).abs().max() < 1e-7
    for camera in range(0, len(cameras), 40):
        expected = opencv_distorted(
            ideal[camera].numpy(), matrices[camera].numpy(), lenses[camera].numpy()
        )
        np.testing.assert_allclose(expected, pixels[camera], atol=1e-7)


def test_a_pixel_beyond_the_fold_is_no_point():
    # k1 = -0.3: the radius grows up to sqrt(1 / 0.9) and there is shown at two thirds of it
    fold = 2 / 3 * (1 / 0.9) ** 0.5
    radius = torch.tensor([0.0, 0.5, 0.99, 0.9999, 1.0001, 1.5, 100], dtype=torch.float64) * fold
    pixels = torch.stack((510 + 1100 * radius, torch.full_like(radius, 495)), dim=-1)
    ideal, exists = undistort(pixels, *as_tensors(K, (-0.3, 0, 0, 0)))
    assert exists.tolist() == [True] * 4 + [False] * 3
    assert torch.equal(ideal[4:], pixels[4:])
    assert ((ideal[:4, 0] - 510) / 1100 <= (1 / 0.9) ** 0.5).all()


def test_a_pole_of_the_rational_model_ends_the_image():
    ideal, exists = undistort(
        *as_tensors([[510 + 1100 * r, 495] for r in (0.1, 0.5, 5)], K, (0, 0, 0, 0, 0, -1, 0, 0))
    )
    assert (
        exists.all()
    )  # r / (1 - r^2) grows up to the pole at radius 1, and shows everything below it
    assert (((ideal - torch.tensor(K[:2, 2])) / 1100).norm(dim=-1) < 1).all()


def test_what_is_not_finite_is_masked_and_changes_nothing_beside_it():
    pixels = torch.from_numpy(np.stack([grid(count=4)] * 3))
    matrices, lenses = as_tensors([K] * 3, [LENSES[2]] * 3)
    before, _ = undistort(pixels, matrices, lenses)
    pixels[0, 3, 1], pixels[0, 5], lenses[2, 1] = torch.nan, torch.inf, torch.nan
    after, exists = undistort(pixels, matrices, lenses)
    bad = torch.zeros(3, 16, dtype=torch.bool)
    bad[0, 3] = bad[0, 5] = bad[2] = True
    assert torch.equal(exists, ~bad)
    assert torch.equal(after[~bad], before[~bad])
    assert torch.isfinite(after).all()


def test_another_number_of_coefficients_is_refused():
    with pytest.raises(ValueError, match="4, 5, 8 or 9"):
        distort(*as_tensors(grid(), K, np.zeros(3)))


FISHEYES = [(0.0, 0.0, 0.0, 0.0), (0.05, -0.01, 0.002, 0.0), (-0.03, 0.02, -0.01, 0.001)]


@pytest.mark.parametrize("coefficients", FISHEYES)
def test_fisheye_is_opencv_s_both_ways(coefficients):
    pixels = grid()
    lens = fisheye_lens(torch.tensor(coefficients, dtype=torch.float64))
    ideal, exists = undistort(*as_tensors(pixels, K), lens)
    assert exists.all()
    np.testing.assert_allclose(distort(ideal, *as_tensors(K), lens), pixels, atol=1e-9)
    rays = np.c_[(ideal.numpy() - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones(len(ideal))]
    zero = np.zeros((3, 1))
    theirs = cv2.fisheye.projectPoints(rays[:, None], zero, zero, K, np.array(coefficients))[0]
    np.testing.assert_allclose(theirs[:, 0], pixels, atol=1e-9)


def test_fisheye_shows_no_pinhole_what_lies_beside_or_behind():
    lens = fisheye_lens(torch.zeros(4, dtype=torch.float64))
    angle = torch.tensor([0.0, 1.2, 1.39, 1.41, 1.6, 3.0], dtype=torch.float64)
    pixels = torch.stack((510 + 1100 * angle, torch.full_like(angle, 495)), dim=-1)
    ideal, exists = undistort(pixels, *as_tensors(K), lens)
    assert exists.tolist() == [True, True, True, False, False, False]
    torch.testing.assert_close(ideal[:3, 0], 510 + 1100 * torch.tan(angle[:3]))


def test_fisheye_that_folds_over_is_undone_up_to_the_fold():
    # theta (1 - 0.5 theta^2) grows up to theta = sqrt(2 / 3)
    fold = (2 / 3) ** 0.5 * 2 / 3
    lens = fisheye_lens(torch.tensor([-0.5, 0, 0, 0], dtype=torch.float64))
    radius = torch.tensor([0.5, 0.9999, 1.0001, 2.0], dtype=torch.float64) * fold
    pixels = torch.stack((510 + 1100 * radius, torch.full_like(radius, 495)), dim=-1)
    assert undistort(pixels, *as_tensors(K), lens)[1].tolist() == [True, True, False, False]


def test_lenses_of_both_kinds_are_undone_each_by_its_own():
    wide = fisheye_lens(torch.tensor(FISHEYES[1], dtype=torch.float64))
    brown = torch.tensor([*LENSES[4], 0.0], dtype=torch.float64)
    lenses = torch.stack((wide, brown))
    assert is_fisheye(lenses).tolist() == [True, False]
    pixels, matrix = as_tensors(grid(), K)
    both, _ = undistort(pixels.expand(2, -1, -1), matrix.expand(2, 3, 3), lenses)
    for one, lens in zip(both, (wide, brown), strict=True):
        torch.testing.assert_close(one, undistort(pixels, matrix, lens)[0], rtol=0, atol=0)
