"""C1 and C4: the same command gives the same bytes; a frame's result does not depend on its batch."""

import copy
import json
from pathlib import Path

import numpy as np
import pytest
import torch

import children
import toys
from ghpt.models.checkpoint import read_checkpoint
from toys import train

SCRIPT = Path(__file__).with_name("run_toy.py")
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


def test_c1_the_same_command_twice(tmp_path, record_row):
    """Other processes, working folders, caches and hash seeds, one of them forked."""
    results = []
    for number, is_forked in enumerate((True, False)):
        folder, cwd = tmp_path / f"run{number}", tmp_path / f"cwd{number}"
        cwd.mkdir()
        environment = {"PYTHONHASHSEED": "12345", "GHPT_CACHE": str(tmp_path / f"cache{number}")}
        words = (SCRIPT, folder, json.dumps({"test": True}))
        children.output_of(*words, env=environment, cwd=cwd, is_forked=is_forked)
        results.append((read_checkpoint(folder / "last.ckpt")["state_dict"], arrays(folder)))
    (weights, first), (again, second) = results
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
