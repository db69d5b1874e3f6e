"""Predict: ``python predict.py keypoints=pose/ cameras=Calib.toml output=out/``; ``--help`` says
more.
"""

from pathlib import Path

from ghpt.commands.app import run
from ghpt.commands.predict import COMMAND

if __name__ == "__main__":
    run(Path(__file__).parent / "conf", COMMAND)
