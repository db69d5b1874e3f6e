"""A script for tests that need processes of their own: ``run_toy.py FOLDER JSON`` trains (and
tests) the toy.

JSON: changes to the toy's settings, ``{"data": {}, "model": {}, "trainer": {}, "train": {}, "test":
true}``.
"""

import json
import sys
import warnings
from pathlib import Path

import toys
from toys import train


def main(folder: str, changes: str) -> None:
    warnings.simplefilter("ignore")
    wanted = json.loads(changes)
    config = toys.TRAIN | wanted.get("train", {})
    for part in ("data", "model", "trainer"):
        config[part] = config[part] | wanted.get(part, {})
    train(config, Path(folder))
    if wanted.get("test"):
        baselines = {"linear": {"_target_": "ghpt.models.estimators.classical.Linear"}}
        again = {
            **config,
            "ckpt": str(Path(folder) / "last.ckpt"),
            "hypotheses": None,
            "baselines": baselines,
        }
        toys.run_test(again, Path(folder))


if __name__ == "__main__":
    main(*sys.argv[1:])
