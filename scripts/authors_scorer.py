"""Make a checkpoint of the pose scorer that the paper's authors published.

    python scripts/authors_scorer.py h36m_original.pt out.ckpt S1/all_3d_gt*.npy
    python scripts/authors_scorer.py cmu.pt out.ckpt all_3d_gt.npy

The weights are a state dict of their network, or a file with one as ``pose_nn_state_dict``; it is
read without running code. What else the network needs is not in it: the mean and the deviation of
the poses that it was trained on. They are taken from the truth that is named: the authors' own
all_3d_gt files, of the subjects that they trained on (their code: S1). Of Human3.6M's 17 joints
they are those of all joints together, of CMU's 19 those of each joint, as in their code.
"""

import argparse
from pathlib import Path

import numpy as np
import torch

from ghpt.commands.display import shell_override
from ghpt.data.formats.validate import read_npy
from ghpt.errors import GhptCheckpointError, GhptDataError
from ghpt.models.checkpoint import FIELD, FORMAT_VERSION, AtomicCheckpointIO, load_model
from ghpt.models.registry import build_registered
from ghpt.provenance import provenance
from ghpt.skeleton import BONES, JOINTS

_STATE = "pose_nn_state_dict"
_OF_COCO19 = (8, 7, 6, 12, 13, 14, 2, None, 0, 1, 5, 4, 3, 9, 10, 11, None)
"""The joint of CMU's 19 that the authors take for each of the 17. It is not the same joint (left is
right, the nose the head's top), but that of their statistics."""
_MEANS = {7: (0, 2), 16: (15, 16, 17, 18)}
_MODES = {
    len(JOINTS) * 3: (True, False),
    len(JOINTS) * 3 + len(BONES): (True, True),
    len(BONES): (False, True),
}
"""Features of the first layer -> whether these are coordinates, and lengths."""
_HINT = "Give the state dict of the authors' pose scorer."


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("weights", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("truth", type=Path, nargs="+", help="all_3d_gt*.npy")
    parser.add_argument("--unit-mm", type=float, default=1.0, help="the truth's unit of length")
    arguments = parser.parse_args()
    try:
        convert(arguments.weights, arguments.output, arguments.truth, arguments.unit_mm)
    except (GhptCheckpointError, GhptDataError) as error:
        parser.exit(1, f"error: {error}\n")
    data = " ".join(data_settings(arguments.truth[0]))
    print(f"Written: {arguments.output}. Test it: python test.py ckpt={arguments.output} {data}")


def convert(weights: Path, output: Path, truth: list[Path], unit_mm: float = 1.0) -> None:
    """Write the checkpoint. Raises GhptCheckpointError and GhptDataError for what does not fit."""
    layers = read_layers(weights)
    mean, deviation = read_statistics(truth, unit_mm)
    inputs = layers[0][0].shape[1]
    if inputs not in _MODES:
        problem = f"takes {inputs} features, not {', '.join(map(str, _MODES))}"
        raise GhptCheckpointError(weights, problem, _HINT)
    coordinates, lengths = _MODES[inputs]
    model = {
        "_target_": "ghpt.models.module.StochasticEstimator",
        "problem": {"_target_": "ghpt.models.pose.authors.WorldPoses"},
        "scorer": {
            "_target_": "ghpt.models.pose.authors.AuthorsScorer",
            "_partial_": True,
            "layers": [weight.shape[0] for weight, _ in layers[:-1]],
            "coordinates": coordinates,
            "lengths": lengths,
        },
        "loss": {
            "_target_": "ghpt.models.loss.StochasticLoss",
            "alpha": 1.0,
            "beta": 0.01,
            "gamma": 0.02,
            "relative_errors": True,
        },
        "optimizer": {"_target_": "torch.optim.Adam", "_partial_": True, "lr": 5e-4},
        "hypotheses": 200,
        "temperature": 1.0,
        "gumbel": False,
        "logit_std_cap": None,
        "selection": "weight",
        "seed": 0,
    }
    state = build_registered(model).state_dict()
    state |= {"scorer.standardise.mean": mean, "scorer.standardise.deviation": deviation}
    state["scorer.standardise.fitted"] = torch.tensor(True)
    for number, (weight, bias) in enumerate(layers):
        state[f"scorer.network.{2 * number}.weight"] = weight
        state[f"scorer.network.{2 * number}.bias"] = bias
    about = {"data": "the authors' own", "source": str(weights)}
    identity = {
        "format_version": FORMAT_VERSION,
        "config": {"model": model},
        "provenance": provenance(0) | about,
    }
    checkpoint = {"state_dict": state, FIELD: identity}
    output.parent.mkdir(parents=True, exist_ok=True)
    AtomicCheckpointIO().save_checkpoint(checkpoint, output)
    load_model(output)


def data_settings(truth: Path) -> list[str]:
    """Return the settings of the data set that a file of truth belongs to."""
    if read_npy(truth, (None, None, 3), "f").shape[1] == len(JOINTS):
        return ["data=h36m", shell_override("data.root", truth.resolve().parents[1])]
    return ["data=cmu2", shell_override("data.root", truth.resolve().parent)]


def read_layers(path: Path) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Return weight and bias of each layer. Raises GhptCheckpointError."""
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch.load's errors are of many kinds
        reason = str(error).split("\n")[0]
        raise GhptCheckpointError(path, f"cannot be read ({reason})", _HINT) from error
    state = content.get(_STATE, content) if isinstance(content, dict) else None
    if not isinstance(state, dict):
        raise GhptCheckpointError(path, "holds no state dict", _HINT)
    numbers = sorted(int(name.split(".")[0]) for name in state if str(name).endswith(".weight"))
    layers = []
    width: int | None = None
    for number in numbers:
        weight = state.get(f"{number}.weight")
        bias = state.get(f"{number}.bias")
        fits = isinstance(weight, torch.Tensor) and isinstance(bias, torch.Tensor)
        if not fits or weight.ndim != 2 or bias.shape != weight.shape[:1]:
            raise GhptCheckpointError(path, f"layer {number} is no linear layer", _HINT)
        if width not in (None, weight.shape[1]):
            problem = f"layer {number} takes {weight.shape[1]} numbers of {width}"
            raise GhptCheckpointError(path, problem, _HINT)
        width = weight.shape[0]
        layers.append((weight.float(), bias.float()))
    if len(layers) < 2 or width != 1 or len(state) != 2 * len(layers):
        raise GhptCheckpointError(path, "is no chain of linear layers to one score", _HINT)
    return layers


def read_statistics(files: list[Path], unit_mm: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Return mean and deviation [17 3], mm, of the truth of some files. Raises GhptDataError."""
    arrays = [read_npy(file, (None, None, 3), "f").astype(np.float64) for file in files]
    counts = {array.shape[1] for array in arrays}
    if counts not in ({17}, {19}):
        problem = f"has {' and '.join(map(str, sorted(counts)))} joints, not 17 or 19"
        raise GhptDataError(files[0], "", problem, "Give the authors' all_3d_gt files.")
    points = np.concatenate(arrays) * unit_mm
    if not len(points) or not np.isfinite(points).all():
        raise GhptDataError(files[0], "", "is empty, or not finite", "Get the file again.")
    if counts == {17}:
        mean = np.broadcast_to(points.mean((0, 1)), (17, 3))
        deviation = np.broadcast_to(points.std((0, 1)), (17, 3))
    else:
        chosen = [
            points[:, _MEANS[joint]].mean(1) if source is None else points[:, source]
            for joint, source in enumerate(_OF_COCO19)
        ]
        joints = np.stack(chosen, axis=1)
        mean = joints.mean(0)
        deviation = joints.std(0)
    return torch.tensor(mean.copy()).float(), torch.tensor(deviation.copy()).float()


if __name__ == "__main__":
    main()
