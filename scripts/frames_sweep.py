"""The sweep over the number of frames M (fig:comparison-to-8-point) on the embedded (synthetic) Human3.6M.

``python scripts/frames_sweep.py [runs/camera/last.ckpt]`` tests a camera model (trained into runs/camera if there is
none) with every M on all six pairs of cameras, beside the classical estimators on the same correspondences. Prints the
table of the paper's pair 2-3 and, for every pair and M, whether the median E_3D of the weighted selection is below that
of the 8-point algorithm and that of RANSAC; draws the figure. Finished cells are kept in runs/frames_sweep, in a folder
of the checkpoint's content and the settings: delete it when the code behind the numbers has changed.
"""

import argparse
import contextlib
import hashlib
import io
import logging
import warnings
from itertools import combinations
from pathlib import Path

import hydra
import numpy as np
import torch
from matplotlib.figure import Figure

from ghpt.config import plain
from ghpt.files import atomic_write
from ghpt.models.checkpoint import FIELD, read_checkpoint
from ghpt.report.pair_evaluate import pair_errors, pair_name
from ghpt.report.pair_predictions import open_pairs
from ghpt.report.sweep import Sweep, frames_sweep, sweep_table
from ghpt.report.tables import markdown
from ghpt.test import test
from ghpt.train import train

ROOT = Path(__file__).resolve().parents[1]
METHODS = ("weight", "average", "eight_point", "ransac", "usac_accurate", "poselib")
TARGETS = ("eight_point", "ransac")
"""Those whose median E_3D the weighted selection is to be below."""
PAIRS = list(combinations(range(4), 2))
PAPER_PAIR = (1, 2)
"""Views 2 and 3 of the paper's figure, counted from 0."""


def compose(name: str, overrides: list[str]) -> dict:
    with hydra.initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return plain(hydra.compose(name, [*overrides, "progress_bar=false", "output=unused"]))


def with_draws(checkpoint: Path, draws: int, folder: Path) -> Path:
    """A copy of the checkpoint that is tested on ``draws`` draws of each rig."""
    content = read_checkpoint(checkpoint)
    content[FIELD]["config"]["model"]["problem"]["draws"] = draws
    path = folder / f"{draws}-draws.ckpt"
    with atomic_write(path) as handle:
        torch.save(content, handle)
    return path


def run(checkpoint: Path, frames: list[int], draws: int, rig: bool) -> tuple[dict[tuple[int, int], Sweep], Path]:
    """Test every M that is not yet done; E_3D (mm) of each draw by pair, method and M, and the folder."""
    digest = hashlib.sha256(checkpoint.read_bytes()).hexdigest()[:12]
    folder = ROOT / "runs" / "frames_sweep" / f"{digest}-{draws}{'-rig' * rig}"
    folder.mkdir(parents=True, exist_ok=True)
    methods = [*METHODS, *["rig"] * rig]
    results: dict[tuple[int, int], dict[str, dict[int, list[float]]]] = {p: {m: {} for m in methods} for p in PAIRS}
    for count in frames:
        output = folder / str(count)
        if not (output / "metrics.json").exists():
            output.mkdir(exist_ok=True)
            config = compose("test", ["data=h36m", f"frames={count}", f"ckpt={with_draws(checkpoint, draws, folder)}"])
            config["camera_baselines"] = {k: v for k, v in config["camera_baselines"].items() if k in methods}
            with contextlib.redirect_stdout(io.StringIO()):  # its table; the numbers are read from the file
                test(config, output)
        predictions = open_pairs(output / "predictions.npz")
        rows = predictions.read(0, len(predictions))
        for method in methods:
            errors = pair_errors(predictions, rows, method)["E_3D"]
            for pair in PAIRS:
                results[pair][method][count] = errors[(rows.pair == torch.tensor(pair)).all(-1)].tolist()
    return results, folder


def comparison(results: dict[tuple[int, int], Sweep], frames: list[int]) -> str:
    """Medians of E_3D by pair and M, weight < the targets; a star where it is not below both. And the counts."""
    median = {
        (pair, method, count): float(np.median(results[pair][method][count]))
        for pair in results
        for method in ("weight", *TARGETS)
        for count in frames
    }
    rows, won = [], dict.fromkeys(TARGETS, 0)
    for count in frames:
        cells = []
        for pair in results:
            ours, *others = (median[pair, method, count] for method in ("weight", *TARGETS))
            for method, other in zip(TARGETS, others, strict=True):
                won[method] += ours < other
            star = "" if all(ours < other for other in others) else " *"
            cells.append(" / ".join(f"{x:.1f}" for x in (ours, *others)) + star)
        rows.append([str(count), *cells])
    table = markdown(["M", *(pair_name(pair) for pair in results)], rows)
    counts = ", ".join(f"below {method} in {n} of {len(frames) * len(results)}" for method, n in won.items())
    return f"{table}\n\nweight is {counts} cells"


def draw(figure: Figure, path: Path) -> None:
    """Write the figure as SVG and as PNG."""
    for suffix, settings in ((".svg", {"metadata": {"Date": None}}), (".png", {"dpi": 150})):
        with atomic_write(path.with_suffix(suffix)) as handle:
            figure.savefig(handle, format=suffix[1:], **settings)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", nargs="?", type=Path, default=ROOT / "runs" / "camera" / "last.ckpt")
    parser.add_argument("--frames", type=int, nargs="+", default=list(range(10, 101, 10)), help="every M")
    parser.add_argument("--draws", type=int, default=10, help="of each of the two rigs (S9, S11)")
    parser.add_argument("--rig", action="store_true", help="also the whole rig's calibration")
    options = parser.parse_args()
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    warnings.simplefilter("ignore")
    if not options.checkpoint.exists() and options.checkpoint == parser.get_default("checkpoint"):
        train(compose("train", ["data=h36m", "model=camera"]), options.checkpoint.parent)
    results, folder = run(options.checkpoint, options.frames, options.draws, options.rig)
    data = f"embedded (synthetic) Human3.6M, {2 * options.draws} draws of M frames ({options.draws} of each rig)"
    name = pair_name(PAPER_PAIR)
    print(f"\nE_3D in mm of pair {name}: mean ± deviation (median); {data}\n\n{sweep_table(results[PAPER_PAIR])}")
    print(f"\nMedian E_3D in mm, weight / {' / '.join(TARGETS)}, * where weight is not below both; {data}\n")
    print(comparison(results, options.frames))
    heading = f"Cameras {name} of embedded (synthetic) Human3.6M, {2 * options.draws} draws of M frames"
    draw(frames_sweep(results[PAPER_PAIR], heading), folder / "frames_sweep")
    print(f"\nFigure: {folder / 'frames_sweep.svg'}, and .png")


if __name__ == "__main__":
    main()
