"""Train: ``python train.py data=cmu2 model=pose``; ``python train.py --help`` says more."""

from pathlib import Path

from ghpt.commands.app import run
from ghpt.commands.train import COMMAND

if __name__ == "__main__":
    run(Path(__file__).parent / "conf", COMMAND)
