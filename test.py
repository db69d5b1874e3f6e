"""Test: ``python test.py ckpt=runs/cmu2/last.ckpt data=h36m``; ``python test.py --help`` says more."""

from pathlib import Path

from ghpt.app import run
from ghpt.test import summary, test

if __name__ == "__main__":
    run(Path(__file__).parent / "conf", "test", test, summary)
