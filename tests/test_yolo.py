"""Ultralytics' labels of poses: shares of the image become pixels of the cameras' images."""

import numpy as np
import pytest
import torch

from ghpt.data.formats.key_points import read_key_points
from ghpt.data.formats.skeletons import SKELETONS
from ghpt.data.people.persons import detector_sequences, person_sequence
from ghpt.data.people.pixel_checks import scale_to_images
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import CameraSet

RNG = np.random.default_rng(0)
BODY = np.column_stack([RNG.uniform(0.1, 0.9, (17, 2)), RNG.uniform(0.1, 1, 17)]).round(6)


def label(joints=BODY, extra=(), box=(0.5, 0.5, 0.2, 0.6)):
    return " ".join(f"{value:g}" for value in (0, *box, *joints.ravel(), *extra))


def write(folder, lines, numbers=(1, 2)):
    folder.mkdir(parents=True, exist_ok=True)
    for number in numbers:
        (folder / f"{folder.name}_{number}.txt").write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("extra", [(), (0.9,), (0.9, 3)])
def test_labels_are_shares_of_the_images(extra, tmp_path):
    for view in ("cam1", "cam2"):
        write(tmp_path / view, [label(BODY, extra), label(BODY / 2, extra)])
    (tmp_path / "classes.txt").write_text("person\n")
    found = read_key_points(tmp_path)
    assert found.joints == SKELETONS["coco_17"]
    assert found.frame.tolist() == [0, 1]
    assert found.normalised
    K = torch.tensor([[1000.0, 0, 500], [0, 1000, 500], [0, 0, 1]], dtype=torch.float64)
    size = torch.tensor([[1920, 1080], [640, 480]])
    cameras = CameraSet(("cam2", "cam1"), K.expand(2, 3, 3), torch.zeros(2, 5), size=size)
    scaled = scale_to_images(found, cameras, [1, 0])
    assert not scaled.normalised
    pixels = scaled.points.pixels[found.row == 0]
    np.testing.assert_allclose(pixels[0], BODY[:, :2] * [640, 480])
    np.testing.assert_allclose(pixels[2], BODY[:, :2] * [1920, 1080])
    np.testing.assert_allclose(scaled.points.confidence[0], BODY[:, 2])
    with pytest.raises(GhptDataError, match="size of their images"):
        scale_to_images(found, CameraSet(cameras.names, cameras.K, cameras.distortion), [1, 0])


@pytest.mark.parametrize("make", [person_sequence, lambda *to: detector_sequences(*to)[0]])
def test_a_person_of_labels_is_in_pixels(make, tmp_path):
    for view in ("cam1", "cam2"):
        write(tmp_path / view, [label()])
    K = torch.tensor([[1000.0, 0, 500], [0, 1000, 500], [0, 0, 1]], dtype=torch.float64)
    size = torch.tensor([[1920, 1080], [640, 480]])
    cameras = CameraSet(("cam1", "cam2"), K.expand(2, 3, 3), torch.zeros(2, 5), size=size)
    sequence = make(read_key_points(tmp_path), cameras)
    ankle = sequence.skeleton.key_points.index("right_ankle")
    found = sequence.detected().pixels[0, :, ankle]
    np.testing.assert_allclose(found, BODY[16, :2] * size.numpy(), rtol=1e-6)


def test_labels_of_images_keep_the_images_numbers(tmp_path):
    for view in ("a", "b"):
        (tmp_path / view).mkdir()
        for number in (1, 2):
            (tmp_path / view / f"{view}_{number:06d}.txt").write_text(label() + "\n")
    assert read_key_points(tmp_path).frame.tolist() == [1, 2]


def test_joints_without_confidence_and_at_zero(tmp_path):
    pairs = BODY[:, :2].copy()
    pairs[3] = 0
    for view in ("a", "b"):
        write(tmp_path / view, [label(pairs)])
    points = read_key_points(tmp_path).points
    expected = np.ones(17)
    expected[3] = 0
    np.testing.assert_array_equal(points.confidence, np.broadcast_to(expected, (4, 17)))
    np.testing.assert_array_equal(points.valid[0], expected == 1)


def test_another_model_s_joints_are_named(tmp_path):
    halpe = np.concatenate([BODY, BODY[:9]])
    for view in ("a", "b"):
        write(tmp_path / view, [label(halpe, (0.9,))])
    assert read_key_points(tmp_path, "halpe_26").joints == SKELETONS["halpe_26"]
    with pytest.raises(GhptDataError, match=r"line 1: has 79 numbers after the box"):
        read_key_points(tmp_path, "coco_17")


@pytest.mark.parametrize(
    ("line", "says"),
    [
        (label().replace(" 0.5 ", " x ", 1), "is not a key-point format"),
        (label() + " x", "line 2: holds what is no number"),
        (label() + " 1 2 3 4", "line 2: has 55 numbers"),
        (label(BODY * 1e8), "line 2: holds a number beyond"),
    ],
)
def test_a_bad_label_is_named(line, says, tmp_path):
    for view in ("a", "b"):
        write(tmp_path / view, [line] if "format" in says else [label(), line])
    with pytest.raises(GhptDataError, match=says):
        read_key_points(tmp_path, None if "format" in says else "coco_17")
