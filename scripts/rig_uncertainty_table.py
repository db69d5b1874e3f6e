"""Whether the ± of calibrate.py hold: differences between rigs in units of their ±.

    python scripts/rig_uncertainty_table.py [--real FOLDER] [--seeds 2] [--actions Walking ...]

Synthetic people are seen by two detectors of the kind ``field`` that err differently, before the
cameras of Human3.6M and of Panoptic. FOLDER holds pose2sim_single/, pose2sim_blazepose/ and
caliscope/. z is the root mean square over all cameras of a difference over what its ± lets expect.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import hydra
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ghpt.calibration.comparison import align
from ghpt.calibration.rig import RigCalibration, RigEstimate
from ghpt.calibration.uncertainty import gauge
from ghpt.commands.time import calibrate_people
from ghpt.config import build, plain
from ghpt.data.formats.camera_files import read_cameras
from ghpt.data.formats.key_points import read_key_points
from ghpt.data.people.persons import detector_sequence
from ghpt.data.people.sequence import KeyPointArrays, Sequence
from ghpt.data.points import KeyPoints
from ghpt.data.synthetic.detector import Detector
from ghpt.data.synthetic.people import y_down
from ghpt.data.synthetic.recordings import draw_motion
from ghpt.data.synthetic.rigs import human36m_rig, panoptic_rig
from ghpt.geometry.cameras import Cameras
from ghpt.geometry.rotations import matrix_to_vector
from ghpt.report.document import Document, Table
from ghpt.report.markdown import render_markdown

ROOT = Path(__file__).resolve().parents[1]
SUBJECT = "S8"
RATE = 50.0
RIGS = {"Human3.6M": human36m_rig(SUBJECT), "Panoptic": panoptic_rig([3, 8, 12, 18, 23])}
REAL = {
    "OpenPose": ("pose2sim_single/pose", "pose2sim_single/Calib_qualisys.toml"),
    "BlazePose": ("pose2sim_blazepose/full.npz", "pose2sim_single/Calib_qualisys.toml"),
    "caliscope": ("caliscope/xy_HOLISTIC.csv", "caliscope/camera_array.toml"),
}


@dataclass(frozen=True)
class Comparison:
    """The squared difference of two rigs, summed over the cameras, and what it should be."""

    rotation: float
    rotation_expected: float
    centre: float
    centre_expected: float
    cameras: int

    @property
    def cells(self) -> list[str]:
        """The difference of rotations, what the ± let expect of it, and both z."""
        degrees = [
            float(np.degrees((total / self.cameras) ** 0.5))
            for total in (self.rotation, self.rotation_expected)
        ]
        z_rotation = (self.rotation / self.rotation_expected) ** 0.5
        z_centre = (self.centre / self.centre_expected) ** 0.5
        return [*(f"{angle:.2f}" for angle in degrees), f"{z_rotation:.2f}", f"{z_centre:.2f}"]

    def __add__(self, other: Comparison) -> Comparison:
        return Comparison(
            *(a + b for a, b in zip(vars(self).values(), vars(other).values(), strict=True))
        )


def compare(found: Cameras, reference: Cameras, covariance: Float[Tensor, "V 6 6"]) -> Comparison:
    """Return how two rigs differ in the gauge of the ±; ``covariance``: of the difference, lengths
    in sizes of the reference rig.
    """
    spread = reference.centre - reference.centre.mean(0)
    size = spread.square().sum(-1).mean().sqrt()
    aligned = align(found, reference).cameras(found)
    turn = matrix_to_vector(aligned.R.mT @ reference.R)
    shift = (aligned.centre - reference.centre) / size
    change = torch.cat((turn, shift), dim=-1).flatten()
    free = gauge(reference.R, reference.centre / size)
    change = change - free @ torch.linalg.lstsq(free, change[:, None]).solution[:, 0]
    square = change.square().unflatten(0, (-1, 6))
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    return Comparison(
        float(square[:, :3].sum()),
        float(variance[:, :3].sum()),
        float(square[:, 3:].sum()),
        float(variance[:, 3:].sum()),
        len(square),
    )


def between(one: RigEstimate, other: RigEstimate) -> Comparison:
    """Return how two calibrations of one rig differ."""
    return compare(one.cameras, other.cameras, one.covariance + other.covariance)


def halves(calibration: RigCalibration, sequence: Sequence) -> Comparison:
    """Return how the rigs of both halves of a recording differ."""
    middle = len(sequence) // 2
    rows = (np.arange(middle), np.arange(middle, len(sequence)))
    one, other = (calibrate_people(calibration, [sequence], 0, half) for half in rows)
    return between(one, other)


def synthetic_sequence(rig: str, action: str, frames: int, seed: int, detector: int) -> Sequence:
    """Return what one of the detectors finds of a synthetic person."""
    with hydra.initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        settings = plain(hydra.compose("detector/field"))["detector"]
    settings["bias_seed"] += detector
    name = f"{SUBJECT}/{action}-{seed}"
    truth = draw_motion(seed, SUBJECT, name, action, frames, RATE)
    if rig == "Panoptic":
        truth = y_down(truth)
    own_seed = seed + 100 * detector
    found = Detector(**settings)(truth, RIGS[rig], RATE, own_seed, SUBJECT, name, False)
    points = KeyPoints(found.key_points, found.confidence, found.valid)
    return Sequence(
        title=name,
        source="synthetic",
        cameras=RIGS[rig],
        frame=np.arange(frames),
        rate_hz=RATE,
        points=KeyPointArrays(points, points),
    )


def synthetic_rows(
    calibration: RigCalibration, actions: list[str], seeds: int
) -> Iterator[list[str]]:
    """Yield a row for each length of recording, and kind of comparison."""
    for frames in (300, 1000):
        of_truth = []
        of_detectors = []
        of_halves = []
        for rig in RIGS:
            for action in actions:
                for seed in range(seeds):
                    seen = [synthetic_sequence(rig, action, frames, seed, k) for k in range(2)]
                    found = [calibrate_people(calibration, [each], 0) for each in seen]
                    true = RIGS[rig].cameras
                    of_truth += [compare(each.cameras, true, each.covariance) for each in found]
                    of_detectors.append(between(*found))
                    of_halves.append(halves(calibration, seen[0]))
        for kind, each in (
            ("against the truth", of_truth),
            ("between two detectors", of_detectors),
            ("halves", of_halves),
        ):
            total = each[0]
            for one in each[1:]:
                total += one
            yield [f"synthetic, {frames} frames: {kind}", *total.cells]


def real_rows(calibration: RigCalibration, folder: Path) -> Iterator[list[str]]:
    """Yield a row for the halves of each recording, and one between the detectors of one."""
    full = {}
    for name, (key_points, cameras) in REAL.items():
        people = read_key_points(folder / key_points, None, None, None, None, 0.0)
        sequence = detector_sequence(people, read_cameras(folder / cameras, None, None))
        full[name] = calibrate_people(calibration, [sequence], 0)
        yield [f"{name}: halves", *halves(calibration, sequence).cells]
    yield ["OpenPose against BlazePose", *between(full["OpenPose"], full["BlazePose"]).cells]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--real", type=Path)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--actions", nargs="*", default=["Walking", "WalkingDog"])
    arguments = parser.parse_args()
    with hydra.initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        groups = plain(hydra.compose("calibrate", ["output=unused"]))
    calibration: RigCalibration = build(groups["calibration"], "calibration")
    rows = [] if arguments.real is None else list(real_rows(calibration, arguments.real))
    rows += synthetic_rows(calibration, arguments.actions, arguments.seeds)
    header = ["", "difference, degrees", "± lets expect", "z, rotation", "z, centre"]
    print(render_markdown(Document("", [Table(header, rows)])))


if __name__ == "__main__":
    main()
