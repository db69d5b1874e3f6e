"""The camera check: ``python cameras.py cameras=Calib.toml keypoints=pose/``; ``--help`` says
more.
"""

from ghpt.commands.catalogue import run_by_name

if __name__ == "__main__":
    run_by_name("cameras")
