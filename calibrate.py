"""Calibrate: ``python calibrate.py keypoints=pose/ cameras=intrinsics.toml output=rig/``;
``--help`` says more.
"""

from ghpt.commands.catalogue import run_by_name

if __name__ == "__main__":
    run_by_name("calibrate")
