"""Test: ``python test.py ckpt=runs/cmu2/last.ckpt data=h36m``; ``python test.py --help`` says more."""

from pathlib import Path

from ghpt.commands.app import run
from ghpt.commands.test import COMMAND

if __name__ == "__main__":
    run(Path(__file__).parent / "conf", COMMAND)
