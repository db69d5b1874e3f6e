"""Train on each of the five arrangements, test on each: ``python scripts/generalization.py [key=value ...]``.

Prints tab:generalization-evaluation for the weighted selection, the paper's numbers in brackets, and the same for the
learning-free average. ``key=value`` changes the training (``model.spread=null``). Finished runs are kept in
``runs/generalization``.
"""

import json
import logging
import sys
import warnings
from pathlib import Path

import hydra
from rich.console import Console
from rich.markdown import Markdown

from ghpt.config import plain
from ghpt.report.tables import generalization_table
from ghpt.test import test
from ghpt.train import train

ROOT = Path(__file__).resolve().parents[1]
ARRANGEMENTS = ("cmu1", "cmu2", "cmu3", "cmu4", "h36m")


def compose(name: str, overrides: list[str]) -> dict:
    with hydra.initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return plain(hydra.compose(name, [*overrides, "progress_bar=false", "output=unused"]))


def main(overrides: list[str]) -> None:
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    warnings.simplefilter("ignore")
    folder = ROOT / "runs" / "generalization" / ("_".join(overrides).replace("/", "-") or "default")
    selections = ("weight", "average")
    errors: dict[str, dict[tuple[str, str], float]] = {name: {} for name in selections}
    for trained in ARRANGEMENTS:
        run = folder / trained
        if not (run / "done").exists():
            train(compose("train", [f"data={trained}", *overrides]), run)
            (run / "done").touch()
        for tested in ARRANGEMENTS:
            output = run / tested
            if not (output / "metrics.json").exists():
                output.mkdir(exist_ok=True)
                config = compose("test", [f"data={tested}", f"ckpt={run / 'last.ckpt'}"])
                test(config | {"baselines": {}}, output)
            metrics = json.loads((output / "metrics.json").read_text())
            for name in selections:
                errors[name][trained, tested] = metrics["selections"][name]["mpjpe_relative"]
    console = Console(width=110)
    console.print("\nweight, pelvis-relative MPJPE in mm, embedded (synthetic) data; the paper's in brackets")
    console.print(Markdown(generalization_table(errors["weight"])))
    means = ", ".join(f"{t.upper()} {errors['average']['h36m', t]:.1f}" for t in ARRANGEMENTS)
    console.print(f"the learning-free average of the same pools: {means}")


if __name__ == "__main__":
    main(sys.argv[1:])
