"""Make a Panoptic-layout folder of real motion: what `python train.py data=cmu1 data.root=FOLDER`
reads.

The poses are CMU Panoptic's own (171026_pose3, 7,181 frames of one person), the calibration that of
160906_band1, and the 2D detections come from the detector model through the real lenses. It needs
the developers' real data.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import yaml

from ghpt.data.synthetic.detector import Detector
from ghpt.data.synthetic.rigs import panoptic_rig
from ghpt.files import atomic_folder
from ghpt.geometry.cameras import CameraSet

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from real_layout import write_panoptic_layout  # noqa: E402

NAME, RATE_HZ = "171026_pose3", 29.97


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="the folder to make; it must not exist yet")
    parser.add_argument(
        "--data",
        type=Path,
        default=ROOT.parent / "shared" / "data",
        help="the developers' real data",
    )
    parser.add_argument(
        "--detector", type=Path, default=ROOT / "conf" / "detector" / "panoptic.yaml"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the detections")
    parser.add_argument("--frames", type=int, default=None, help="only so many, from the start")
    arguments = parser.parse_args()

    if arguments.folder.exists():
        parser.error(f"{arguments.folder} exists; name a new folder")
    detector = Detector(**yaml.safe_load(arguments.detector.read_text(encoding="utf-8")))
    take = np.load(arguments.data / "panoptic" / f"{NAME}_joints19.npz")
    calibration = arguments.data / "panoptic" / "160906_band1" / "calibration_160906_band1.json"

    def detect(rig: CameraSet, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        found = detector(poses, rig, RATE_HZ, arguments.seed, NAME, NAME)
        return found.key_points, found.confidence, found.valid

    with atomic_folder(arguments.folder) as folder:
        write_panoptic_layout(
            folder,
            NAME,
            json.loads(calibration.read_text(encoding="utf-8")),
            panoptic_rig(range(31)),
            take["frames"][: arguments.frames].tolist(),
            take["poses"][: arguments.frames],
            detect,
        )
    print(
        f"{arguments.folder}: {NAME}, {len(take['frames'][: arguments.frames])} frames, 31 cameras"
    )


if __name__ == "__main__":
    main()
