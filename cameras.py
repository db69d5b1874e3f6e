"""The camera doctor: ``python cameras.py cameras=Calib.toml keypoints=pose/``; ``--help`` says
more.
"""

from pathlib import Path

from ghpt.commands.app import run
from ghpt.commands.cameras import COMMAND

if __name__ == "__main__":
    run(Path(__file__).parent / "conf", COMMAND)
