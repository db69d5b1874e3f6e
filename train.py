"""Train: ``python train.py data=cmu2 model=pose``; ``python train.py --help`` says more."""

from ghpt.commands.catalogue import run_by_name

if __name__ == "__main__":
    run_by_name("train")
