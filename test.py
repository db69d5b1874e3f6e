"""Test: ``python test.py ckpt=runs/cmu2/last.ckpt data=h36m``; ``--help`` says more."""

from ghpt.commands.catalogue import run_by_name

if __name__ == "__main__":
    run_by_name("test")
