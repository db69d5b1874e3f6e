"""Put the weights of a trained small model into the package.

    python train.py data=random model=key_points output=runs/key_points
    python scripts/ship_weights.py runs/key_points/last.ckpt key_points

Writes src/ghpt/weights/NAME.npz; the card beside it, NAME.md, is written by hand.
"""

import argparse
from pathlib import Path

from ghpt.models.checkpoint import load_model
from ghpt.models.weights import write_weights

FOLDER = Path(__file__).resolve().parents[1] / "src" / "ghpt" / "weights"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("ckpt", type=Path, help="a checkpoint of train.py")
    parser.add_argument("name", help="of the weights, e.g. key_points")
    arguments = parser.parse_args()
    model, trained = load_model(arguments.ckpt, ())
    path = FOLDER / f"{arguments.name}.npz"
    write_weights(model, trained, path)
    print(f"{path}: {path.stat().st_size} bytes")


if __name__ == "__main__":
    main()
