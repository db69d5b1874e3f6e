"""Calibrate: ``python calibrate.py keypoints=pose/ cameras=intrinsics.toml output=rig/``;
``--help`` says more.
"""

from pathlib import Path

from ghpt.commands.app import run
from ghpt.commands.calibrate import COMMAND

if __name__ == "__main__":
    run(Path(__file__).parent / "conf", COMMAND)
