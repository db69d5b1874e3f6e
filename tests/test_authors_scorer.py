"""The authors' scorer: a state dict as theirs becomes a checkpoint that weighs as their code."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from ghpt.errors import GhptCheckpointError, GhptDataError
from ghpt.models.checkpoint import load_model

SCRIPT = Path(__file__).resolve().parents[1] / "scripts" / "authors_scorer.py"
WIDTHS = (6, 5, 4)
CONNECTED = (
    *((0, 1), (1, 2), (2, 6), (5, 4), (4, 3), (3, 6), (6, 7), (7, 8)),
    *((8, 9), (9, 16), (8, 12), (11, 12), (10, 11), (8, 13), (13, 14), (14, 15)),
)
"""The bones of their Human3.6M, in their order."""


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("authors_scorer", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def their_network(inputs: int) -> nn.Sequential:
    """Linear layers and ReLU6 by turns, and a sigmoid at the end."""
    torch.manual_seed(0)
    modules = []
    for width in WIDTHS:
        modules += [nn.Linear(inputs, width), nn.ReLU6()]
        inputs = width
    return nn.Sequential(*modules, nn.Linear(inputs, 1), nn.Sigmoid())


def their_features(pose: torch.Tensor, mean, deviation, mode: int) -> torch.Tensor:
    """What their code makes of one pose [17 3]."""
    pose = (pose - mean) / deviation
    pose = pose - pose[6]
    lengths = torch.stack([(pose[a] - pose[b]).norm() for a, b in CONNECTED])
    normal = torch.linalg.cross(pose[6] - pose[12], pose[13] - pose[12])
    z = torch.tensor([0.0, 0.0, 1.0])
    axis = torch.linalg.cross(z, normal)
    x, y, w = (axis / axis.norm() * torch.acos(z @ normal)).tolist()
    turn = torch.matrix_exp(torch.tensor([[0, -w, y], [w, 0, -x], [-y, x, 0]]))
    flat = (pose @ turn).flatten()
    return {0: flat, 1: torch.cat([flat, lengths]), 2: lengths}[mode]


def truth(folder: Path, joints: int) -> Path:
    rng = np.random.default_rng(0)
    poses = rng.normal(0, 200, (50, joints, 3)) + rng.normal(0, 900, (50, 1, 3))
    np.save(folder / "all_3d_gt0.npy", poses.astype(np.float32))
    return folder / "all_3d_gt0.npy"


@pytest.mark.parametrize(("mode", "inputs"), [(0, 51), (1, 67), (2, 16)])
def test_weights_are_those_of_their_code(script, mode, inputs, tmp_path):
    network = their_network(inputs)
    torch.save({"epoch": 3, "pose_nn_state_dict": network.state_dict()}, tmp_path / "w.pt")
    file = truth(tmp_path, 17)
    script.convert(tmp_path / "w.pt", tmp_path / "out.ckpt", [file])
    model, about = load_model(tmp_path / "out.ckpt")
    poses = torch.tensor(np.load(file)[:20]).float()
    mean, deviation = poses.new_tensor(np.load(file).mean((0, 1))), np.load(file).std((0, 1))
    features = [their_features(pose, mean, torch.tensor(deviation), mode) for pose in poses]
    with torch.no_grad():
        scores = network(torch.stack(features))[:, 0]
        logits = model.scorer(poses.flatten(-2))
    torch.testing.assert_close(torch.softmax(logits, 0), scores / scores.sum())
    assert model.temperature == 1
    assert about["provenance"]["source"].endswith("w.pt")


def test_the_statistics_of_cmu_are_of_each_joint(script, tmp_path):
    file = truth(tmp_path, 19)
    mean, deviation = script.read_statistics([file], unit_mm=10.0)
    poses = 10 * np.load(file).astype(np.float64)
    np.testing.assert_allclose(mean[0], poses[:, 8].mean(0), rtol=1e-5)
    np.testing.assert_allclose(deviation[15], poses[:, 11].std(0), rtol=1e-5)
    np.testing.assert_allclose(mean[7], poses[:, [0, 2]].mean((0, 1)), rtol=1e-5)


def without_bias(state):
    del state["2.bias"]


def of_two_scores(state):
    state["6.weight"], state["6.bias"] = torch.zeros(2, 4), torch.zeros(2)


def of_other_features(state):
    state["0.weight"] = torch.zeros(6, 20)


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (without_bias, "layer 2 is no linear layer"),
        (of_two_scores, "no chain of linear layers to one score"),
        (of_other_features, "takes 20 features, not 51, 67, 16"),
    ],
)
def test_other_weights_are_named(script, spoil, says, tmp_path):
    state = their_network(16).state_dict()
    spoil(state)
    torch.save(state, tmp_path / "w.pt")
    with pytest.raises(GhptCheckpointError, match=says):
        script.convert(tmp_path / "w.pt", tmp_path / "out.ckpt", [truth(tmp_path, 17)])
    assert not (tmp_path / "out.ckpt").exists()


def test_a_truth_of_other_joints_is_named(script, tmp_path):
    with pytest.raises(GhptDataError, match="has 18 joints, not 17 or 19"):
        script.read_statistics([truth(tmp_path, 18)], unit_mm=1.0)
