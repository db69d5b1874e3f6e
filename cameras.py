"""The camera doctor: ``python cameras.py cameras=Calib.toml keypoints=pose/``; ``--help`` says more."""

from pathlib import Path

from ghpt.app import run
from ghpt.doctor import COMMAND

if __name__ == "__main__":
    run(Path(__file__).parent / "conf", COMMAND)
