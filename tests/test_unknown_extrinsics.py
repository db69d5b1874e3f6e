"""The algebra of scripts/unknown_extrinsics.py: estimated extrinsics in place of the true ones."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch
from scipy.spatial.transform import Rotation

from ghpt.data.rigs import human36m_rig
from ghpt.geometry.cameras import Cameras
from ghpt.recording import PairBatch, RelativePoseEstimate


@pytest.fixture(scope="module")
def script() -> ModuleType:
    path = Path(__file__).resolve().parents[1] / "scripts" / "unknown_extrinsics.py"
    spec = importlib.util.spec_from_file_location("unknown_extrinsics", path)
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


TRUTH = human36m_rig("S9").cameras


def wrong(script: ModuleType) -> tuple[torch.Tensor, torch.Tensor]:
    """True relative poses turned by some degrees and moved by some centimetres, but for the first."""
    R, t = script.relative(TRUTH)
    turn = torch.from_numpy(Rotation.from_euler("xyz", [[0, 0, 0], [3, 0, 1], [0, 2, 0], [1, 1, 1]], True).as_matrix())
    return turn @ R, t + torch.tensor([[0.0], [40.0], [-70.0], [25.0]])


@pytest.mark.parametrize("part", ["R", "t", "both"])
def test_true_relative_poses_give_back_the_true_cameras(script, part):
    found = script.replaced(TRUTH, script.relative(TRUTH), *script.PARTS[part])
    torch.testing.assert_close(found.R, TRUTH.R, rtol=0, atol=1e-12)
    torch.testing.assert_close(found.t, TRUTH.t, rtol=0, atol=1e-8)
    assert found.K is TRUTH.K


@pytest.mark.parametrize(("part", "use_R", "use_t"), [("R", True, False), ("t", False, True), ("both", True, True)])
def test_only_the_wanted_part_of_the_relative_pose_is_estimated(script, part, use_R, use_t):
    estimate = wrong(script)
    found = script.replaced(TRUTH, estimate, *script.PARTS[part])
    R, t = script.relative(found)
    true_R, true_t = script.relative(TRUTH)
    torch.testing.assert_close(R, estimate[0] if use_R else true_R, rtol=0, atol=1e-12)
    torch.testing.assert_close(t, estimate[1] if use_t else true_t, rtol=0, atol=1e-8)
    assert (found.R[1:] - TRUTH.R[1:]).abs().amax() > 1e-3 or part == "t"
    assert (found.t[1:] - TRUTH.t[1:]).abs().amax() > 1  # a turn about the reference moves the others too
    torch.testing.assert_close(found.R[0], TRUTH.R[0], rtol=0, atol=1e-12)
    torch.testing.assert_close(found.t[0], TRUTH.t[0], rtol=0, atol=1e-8)


def test_rig_in_any_frame_and_unit_gives_back_the_true_cameras(script):
    turn = torch.from_numpy(Rotation.from_rotvec([0.3, -1.2, 0.5]).as_matrix())
    R = TRUTH.R @ turn
    moved = Cameras(TRUTH.K, R, 0.002 * (TRUTH.t + R @ torch.tensor([100.0, -2000.0, 700.0], dtype=torch.float64)))
    found = script.replaced(TRUTH, script.with_true_scale(moved, TRUTH), True, True)
    torch.testing.assert_close(found.R, TRUTH.R, rtol=0, atol=1e-12)
    torch.testing.assert_close(found.t, TRUTH.t, rtol=0, atol=1e-7)


def test_pairs_with_the_first_camera_are_taken_in_its_order(script):
    pair = torch.tensor([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
    rig = Cameras(*(x.expand(len(pair), *x.shape) for x in (TRUTH.K, TRUTH.R, TRUTH.t)))
    number, view = torch.arange(len(pair)), torch.zeros(len(pair), 4, 1, 17)
    points = torch.zeros(len(pair), 1, 3, dtype=torch.float64)
    batch = PairBatch(number, 0 * number, 0 * number, pair, rig, torch.zeros(*view.shape, 2), view, view > 0, points)
    a, b = (batch.pair_cameras().index((slice(None), i)) for i in (0, 1))
    R = b.R @ a.R.mT
    t = b.t - (R @ a.t[..., None])[..., 0]
    estimate = RelativePoseEstimate(R, t, torch.ones(len(pair), dtype=torch.bool))
    found = script.replaced(TRUTH, script.from_pairs(estimate, batch, "truth"), True, True)
    torch.testing.assert_close(found.R, TRUTH.R, rtol=0, atol=1e-12)
    torch.testing.assert_close(found.t, TRUTH.t, rtol=0, atol=1e-8)
    missing = RelativePoseEstimate(R, t, torch.arange(len(pair)) != 1)
    with pytest.raises(script.GhptDataError, match="a pair has no estimate"):
        script.from_pairs(missing, batch, "truth")
