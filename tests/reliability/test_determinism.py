"""C1 and C4: the same command gives the same bytes; a frame's result does not depend on its batch."""

import copy
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import children
import sizes
import toys
from ghpt.models.checkpoint import read_checkpoint

sys.path.insert(0, str(Path(__file__).resolve().parent))

import run_toy

from toys import train

BASELINES = {
    "linear": {"_target_": "ghpt.models.estimators.classical.Linear"},
    "ransac": {
        "_target_": "ghpt.models.estimators.ransac.Ransac",
        "threshold": 0.02,
        "pairs": 4,
        "seed": 0,
    },
}


def arrays(folder):
    with np.load(folder / "predictions.npz") as file:
        return {name: file[name] for name in file.files if name != "meta"}


@pytest.fixture(scope="module")
def here(tmp_path_factory):
    """The folder of a training and its test in this process."""
    folder = tmp_path_factory.mktemp("here")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GHPT_CACHE", str(folder / "cache"))
        run_toy.main(str(folder / "run"), json.dumps({"test": True}))
    return folder / "run"


@pytest.mark.parametrize("is_forked", [True] if not sizes.NIGHTLY else [True, False])
def test_c1_the_same_command_twice(tmp_path, here, record_row, is_forked):
    """In another process, working folder and cache, with another hash seed."""
    folder = tmp_path / "run"
    environment = {"GHPT_CACHE": str(tmp_path / "cache"), "PYTHONHASHSEED": "12345"}
    words = (run_toy.__file__, folder, json.dumps({"test": True}))
    children.output_of(*words, env=environment, cwd=tmp_path, is_forked=is_forked)
    weights, again = (read_checkpoint(f / "last.ckpt")["state_dict"] for f in (here, folder))
    first, second = arrays(here), arrays(folder)
    same = sum(torch.equal(v, again[k]) for k, v in weights.items())
    same += sum(v.tobytes() == second[k].tobytes() for k, v in first.items())
    total = len(weights) + len(first)
    record_row(
        "C1", f"the same command twice: {same} of {total} arrays identical to the bit", same, total
    )
    assert same == total


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    folder = tmp_path_factory.mktemp("c4")
    train(copy.deepcopy(toys.TRAIN), folder)
    return folder / "last.ckpt"


def predictions_of(checkpoint, folder, threads, **data):
    config = copy.deepcopy(toys.TRAIN) | {
        "ckpt": str(checkpoint),
        "hypotheses": None,
        "baselines": BASELINES,
    }
    config["data"] |= data
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        toys.run_test(config, folder)
    finally:
        torch.set_num_threads(before)
    return arrays(folder)


def test_c4_batch_size_threads_and_workers_do_not_matter(
    tmp_path, checkpoint, blank_figures, record_row
):
    reference = predictions_of(checkpoint, tmp_path / "reference", 1, batch_size=16)
    runs = [(1, 1, 0), (4096, 2, 0), (7, 2, 2)]
    worst, differing = 0.0, 0
    for batch_size, threads, workers in runs:
        folder = tmp_path / f"{batch_size}-{threads}-{workers}"
        found = predictions_of(checkpoint, folder, threads, batch_size=batch_size, workers=workers)
        for name, value in reference.items():
            if name.startswith(("points_", "weights_")) and name not in (
                "points_random",
                "points_best",
                "points_worst",
            ):
                assert np.array_equal(np.isnan(value), np.isnan(found[name]))
                worst = max(
                    worst, np.nanmax(np.abs(value.astype(np.float64) - found[name]), initial=0)
                )
            else:
                differing += value.tobytes() != found[name].tobytes()
    figure = f"{len(runs)} ways to batch: {differing} masks or learning-free arrays differ, learned ones by {worst:.2g} mm"
    record_row("C4", figure, len(runs) if worst < 1e-2 and not differing else 0, len(runs))
    assert differing == 0
    assert worst < 1e-2  # the scorer is float32, and matrix products round by their shape
