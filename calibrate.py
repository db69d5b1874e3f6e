"""Calibrate: ``python calibrate.py keypoints=pose/ cameras=intrinsics.toml output=rig/``; ``--help`` says more."""

from pathlib import Path

from ghpt.app import run
from ghpt.calibrate import calibrate, summary

if __name__ == "__main__":
    run(Path(__file__).parent / "conf", "calibrate", calibrate, summary)
