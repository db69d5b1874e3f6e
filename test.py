"""Test: ``python test.py ckpt=runs/cmu2/last.ckpt data=h36m``; ``python test.py --help`` says more."""

from pathlib import Path

from ghpt.test import test

from ghpt.app import run

if __name__ == "__main__":
    run(Path(__file__).parent / "conf", "test", test)
