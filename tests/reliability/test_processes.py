"""C2 and C3: one process and several give the same numbers, with missing joints and uneven
shares."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

import children

SCRIPT = Path(__file__).with_name("run_toy.py")


def run(folder, processes, samples, **changes):
    wanted = {
        "data": {"train_samples": samples, "missing": 0.3, "batch_size": 16},
        "trainer": {
            "devices": processes,
            "strategy": "ddp" if processes > 1 else "auto",
            "max_epochs": 7,
        },
        "model": {"optimizer": {"_target_": "torch.optim.SGD", "_partial_": True, "lr": 0.1}},
        **changes,
    }
    children.output_of(SCRIPT, folder, json.dumps(wanted), env=children.RANKS)
    return torch.load(folder / "last.ckpt", weights_only=True)


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    """97 samples in batches of 16: the last batch is one sample, and the second process has none of
    it.
    """
    folders = {n: tmp_path_factory.mktemp(f"processes{n}") for n in (1, 2)}
    return {n: (run(folder, n, 97, test=True), folder) for n, folder in folders.items()}


def test_training_is_the_same_on_two_processes(pairs, record_row):
    one, two = (pairs[n][0] for n in (1, 2))
    assert one["global_step"] == two["global_step"] == 49
    worst = max(
        ((two["state_dict"][k] - v).norm() / v.norm()).item()
        for k, v in one["state_dict"].items()
        if v.is_floating_point()
    )
    moved = (one["state_dict"]["scorer.network.0.weight"] - initial()).norm()
    record_row(
        "C2",
        f"weights after 49 steps, 1 against 2 processes: relative difference {worst:.2g}",
        worst <= 1e-6,
        1,
    )
    assert moved > 1e-3
    assert worst <= 1e-6


def initial():
    import toys
    from ghpt.config import build

    return build(toys.MODEL).scorer.network[0].weight.detach()


def test_validation_and_predictions_are_the_same_on_two_processes(pairs, record_row):
    (one, first), (two, second) = pairs[1], pairs[2]
    a, b = (json.loads((folder / "metrics.json").read_text()) for folder in (first, second))
    assert a["frames"] == b["frames"] == 30
    # the weights differ in their last digits, so the learned selections do; what does not use them
    # is identical
    with np.load(first / "predictions.npz") as x, np.load(second / "predictions.npz") as y:
        assert x.files == y.files
        same = [
            name
            for name in x.files
            if name != "meta"
            and np.array_equal(x[name], y[name], equal_nan=x[name].dtype.kind == "f")
        ]
        for name in (
            "points_linear",
            "points_random",
            "points_best",
            "frame",
            "recording",
            "truth",
        ):
            assert name in same
        for name in x.files:
            if name.startswith("points_weight"):
                np.testing.assert_allclose(x[name], y[name], rtol=0, atol=1e-2)
    worst = max(
        abs(a["selections"][name]["mpjpe_relative"] / b["selections"][name]["mpjpe_relative"] - 1)
        for name in ("weight", "average", "random", "best", "worst", "linear")
    )
    record_row(
        "C3",
        f"test metrics, 1 against 2 processes: relative difference {worst:.2g}",
        int(worst <= 1e-6),
        1,
    )
    assert worst <= 1e-6
    scores = [
        next(v for k, v in c["callbacks"].items() if "ModelCheckpoint" in k)["best_model_score"]
        for c in (one, two)
    ]
    assert scores[0].item() == pytest.approx(scores[1].item(), rel=1e-6)
