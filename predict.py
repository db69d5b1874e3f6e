"""Predict: ``python predict.py keypoints=pose/ cameras=Calib.toml output=out/``; ``--help`` says
more.
"""

from ghpt.commands.catalogue import run_by_name

if __name__ == "__main__":
    run_by_name("predict")
