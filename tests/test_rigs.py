import numpy as np
import pytest
import torch

from ghpt.data.synthetic.rigs import ARRANGEMENTS, human36m_rig, panoptic_rig
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import project

RIGS = {f"S{k}": human36m_rig(f"S{k}") for k in range(1, 12)} | {
    "panoptic": panoptic_rig(range(31))
}


@pytest.mark.parametrize("name", RIGS)
def test_rotations_are_proper(name):
    R = RIGS[name].cameras.R
    assert torch.allclose(R @ R.mT, torch.eye(3, dtype=R.dtype).expand_as(R), atol=1e-8)
    assert torch.allclose(torch.linalg.det(R), torch.ones(len(R), dtype=R.dtype), atol=1e-8)


@pytest.mark.parametrize("name", RIGS)
def test_knees_to_shoulders_of_a_person_in_the_middle_are_in_every_image(name):
    rig = RIGS[name]
    knees_to_shoulders = torch.tensor([[0.0, 0.0, 600.0], [0.0, 0.0, 1500.0]], dtype=torch.float64)
    if name == "panoptic":
        knees_to_shoulders = torch.stack(
            [knees_to_shoulders[:, 0], -knees_to_shoulders[:, 2], knees_to_shoulders[:, 1]], dim=-1
        )
    pixels, depth = project(rig.cameras, knees_to_shoulders)
    assert (depth > 1000).all()
    assert (depth < 8000).all()
    assert ((pixels > 0) & (pixels < rig.size[:, None])).all()


@pytest.mark.parametrize("name", RIGS)
def test_the_head_is_above_the_feet_in_every_image(name):
    up = torch.tensor(
        [0.0, -1.0, 0.0] if name == "panoptic" else [0.0, 0.0, 1.0], dtype=torch.float64
    )
    pixels, _ = project(
        RIGS[name].cameras, up * torch.tensor([[300.0], [1700.0]], dtype=torch.float64)
    )
    assert (pixels[:, 1, 1] < pixels[:, 0, 1]).all()


def test_principal_points_and_focal_lengths_fit_the_image_sizes():
    for rig in RIGS.values():
        focal = rig.cameras.K.diagonal(dim1=-2, dim2=-1)[:, :2]
        assert ((rig.cameras.K[:, :2, 2] / rig.size - 0.5).abs() < 0.06).all()
        assert ((focal / rig.size.max(dim=1, keepdim=True).values - 1).abs() < 0.3).all()


def test_cameras_keep_the_order_asked_for():
    rig = panoptic_rig((18, 10))
    assert rig.names == ("00_18", "00_10")
    assert torch.equal(rig.cameras.t, RIGS["panoptic"].cameras.t[[18, 10]])


def test_every_arrangement_exists():
    for name, numbers in ARRANGEMENTS.items():
        assert len(human36m_rig("S1") if name == "h36m" else panoptic_rig(numbers)) == len(numbers)


def test_the_numbers_are_those_of_the_real_files(shared_data):
    import json

    table = json.loads(
        (shared_data / "panoptic/160906_band2/calibration_160906_band2.json").read_text()
    )
    other = {c["name"]: c for c in table["cameras"] if c["type"] == "hd"}
    for name, K in zip(RIGS["panoptic"].names, RIGS["panoptic"].cameras.K, strict=True):
        np.testing.assert_allclose(K.numpy(), other[name]["K"], rtol=0.02)
    table = json.loads((shared_data / "human36m/camera-parameters.json").read_text())
    for name, t in zip(RIGS["S9"].names, RIGS["S9"].cameras.t, strict=True):
        np.testing.assert_array_equal(t.numpy(), np.ravel(table["extrinsics"]["S9"][name]["t"]))


@pytest.mark.parametrize(
    ("numbers", "words"),
    [((1, 31), "camera 31"), ((-1, 2), "camera -1"), ((4, 7, 4), "camera 4 .*twice"), ((5,), "5")],
)
def test_bad_camera_lists_are_named(numbers, words):
    with pytest.raises(GhptDataError, match=words):
        panoptic_rig(numbers)


def test_an_unknown_subject_is_named():
    with pytest.raises(GhptDataError, match="S12"):
        human36m_rig("S12")
