"""The paper's training job beside the authors' own code: ``python benchmarks/authors.py
authors=/path/to/checkout``.

Their code (github.com/kristijanbartol/general-3d-humans) is run from the given checkout and is no
part of this project. It needs, beside what is here, OpenCV and a kornia below 0.7: ``pip install
--no-deps --target DIR "kornia==0.6.12"`` and ``PYTHONPATH=DIR``.

Both get the same frames, 4 views, 200 hypotheses and the same features. Theirs goes hypothesis by
hypothesis, so a batch of 16 frames is timed (forward frame by frame, one backward and Adam step)
and multiplied up to the job; ours is timed whole, with the data, the feature statistics, validation
and checkpoints.

Settings: ``authors=PATH`` ``frames=16`` ``samples=512``.
"""

import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import scene
import torch
from measure import configuration, machine, settings, show

from ghpt.commands.train import TrainSettings, train
from ghpt.config import settings as typed_settings

HYPOTHESES = 200


def theirs(authors: str, frames: int) -> tuple[float, float]:
    """Return the seconds a frame of their forward pass, and of their backward pass with a step."""
    sys.path.insert(0, authors)
    # they move the scorer's input to the GPU whatever the device is
    torch.Tensor.cuda = lambda self, *_, **__: self
    warnings.filterwarnings("ignore")
    from src.dsac import PoseDSAC
    from src.loss import MPJPELoss
    from src.metrics import GlobalMetrics
    from src.score import create_pose_nn

    scorer = create_pose_nn(input_size=17 * 3 + 16, hidden_layer_sizes=[1000, 900, 900, 900, 700])
    model = PoseDSAC(
        hyps=HYPOTHESES,
        num_joints=17,
        entropy_beta=0.01,
        entropy_to_scores=False,
        temp=1.5,
        gumbel=True,
        hard=False,
        body_lengths_mode=1,
        weighted_selection=True,
        exp_beta=1.0,
        est_beta=0.02,
        score_nn=scorer,
        loss_function=MPJPELoss(),
    )
    optimizer = torch.optim.Adam(scorer.parameters(), lr=5e-4)
    recording = scene.take("theirs", frames, scene.ring(4), np.random.default_rng(0))
    key_points = torch.from_numpy(recording.key_points)
    truth = torch.from_numpy(recording.truth)
    cameras = recording.cameras.to(torch.float32)
    t = cameras.t[..., None]
    mean = truth.mean(dim=0)
    deviation = torch.full((17, 3), 1000.0)  # as of people who walk about a room
    metrics = GlobalMetrics("human36m")

    start = time.perf_counter()
    losses = []
    for points, true_points in zip(key_points, truth, strict=True):
        loss, *_ = model(points, cameras.K, cameras.R, t, mean, deviation, true_points, metrics)
        losses.append(loss)
    forward = time.perf_counter()
    total = torch.stack(losses).sum()
    total.backward()
    optimizer.step()
    if not torch.isfinite(total):
        sys.exit("their loss is not finite, so their time means nothing")
    return (forward - start) / frames, (time.perf_counter() - forward) / frames


def ours(samples: int, bfloat16: bool) -> float:
    """Seconds of the whole training."""
    with tempfile.TemporaryDirectory() as folder:
        config = configuration("train", "progress_bar=false", f"model.hypotheses={HYPOTHESES}")
        config["model"]["scorer"]["bfloat16"] = bfloat16
        lengths = {"train": 8 * samples, "validation": 64, "test": 16}
        config["data"] = scene.DATA | {
            "cache": folder,
            "views": 4,
            "frames": lengths,
            "train_samples": samples,
        }
        config["trainer"] |= {"accelerator": "cpu", "devices": 1}
        _prepare(config["data"])
        start = time.perf_counter()
        output = Path(folder) / "run"
        typed = typed_settings(TrainSettings, config | {"output": str(output)})
        train(typed, output)
        return time.perf_counter() - start


def _prepare(data: dict[str, Any]) -> None:
    arguments = {name: value for name, value in data.items() if name != "_target_"}
    scene.SceneData(**arguments).setup("fit")


def main() -> None:
    wanted = settings(authors="", frames=16, samples=512)
    if not Path(wanted["authors"], "src", "dsac.py").is_file():
        sys.exit("Give the authors' checkout: authors=/path/to/general-3d-humans")
    title = machine()
    jobs = {kind: ours(wanted["samples"], kind == "bfloat16") for kind in ("float32", "bfloat16")}
    forward, backward = theirs(wanted["authors"], wanted["frames"])
    samples, theirs_job = wanted["samples"], wanted["samples"] * (forward + backward)
    rows = [
        ["theirs, a frame", f"{forward:.2f} s forward, {backward:.2f} s backward and step"],
        [f"theirs, {samples} frames, by multiplication", f"{theirs_job:.0f} s"],
        *(
            [f"ours, {samples} frames, {kind}", f"{s:.1f} s, ratio {theirs_job / s:.0f}"]
            for kind, s in jobs.items()
        ),
    ]
    show(title, ["training, 4 views, 200 hypotheses", "time"], rows)


if __name__ == "__main__":
    main()
