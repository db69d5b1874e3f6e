"""What people in view tell of the time of cameras, and of focal lengths that nobody gave.

``python scripts/unknowns_table.py time`` and ``focal`` draw synthetic people before Human3.6M's
cameras at 200 Hz, have each camera record 12 s of them at 50 Hz from a start of its own, and print
the errors. ``--detector field`` errs as detectors in the field do; ``--actions`` chooses what the
people do.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import hydra
import numpy as np
import torch
from jaxtyping import Float, Int

from ghpt.calibration.intrinsics import IntrinsicsEstimation
from ghpt.calibration.rig import RigCalibration
from ghpt.calibration.time.estimation import TimeEstimation
from ghpt.calibration.time.timeline import timeline_of
from ghpt.config import build, plain
from ghpt.data.points import KeyPoints
from ghpt.data.synthetic.detector import Detector
from ghpt.data.synthetic.recordings import draw_motion
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.report.document import Document, Table
from ghpt.report.markdown import render_markdown

ROOT = Path(__file__).resolve().parents[1]
MOVING = ("Directions", "Greeting", "Posing", "Purchases", "TakingPhoto", "Walking", "WalkingDog")
SUBJECT = "S8"
TICKS = 200
STEP = 4
FRAMES = 600
LATEST = 1000
"""Ticks a second and a frame, frames of a recording, and the latest start in ticks."""
RIG = human36m_rig(SUBJECT)


@dataclass(frozen=True)
class Recorded:
    """What the cameras recorded."""

    name: str
    points: KeyPoints
    """[T V J], undistorted."""
    start: Float[np.ndarray, " V"]
    """Frames."""


def record(detector: Detector, action: str, seed: int, starts: Int[np.ndarray, " V"]) -> Recorded:
    """Return what cameras that start at these ticks record of a person."""
    name = f"{SUBJECT}/{action}-{seed}"
    ticks = LATEST + STEP * FRAMES
    truth = draw_motion(seed, SUBJECT, name, action, ticks, float(TICKS))
    found = detector(truth, RIG, float(TICKS), seed, SUBJECT, name, False)

    def own(values: np.ndarray) -> np.ndarray:
        rows = [slice(start, start + STEP * FRAMES, STEP) for start in starts]
        return np.stack([values[row, view] for view, row in enumerate(rows)], axis=1)

    points = KeyPoints(own(found.key_points), own(found.confidence), own(found.valid))
    return Recorded(name, points, starts / STEP)


def half_rate(recorded: Recorded) -> Recorded:
    """Return the recording with half of the last camera's frames."""
    half = FRAMES // 2
    points = recorded.points
    pixels = points.pixels.copy()
    valid = points.valid.copy()
    pixels[:half, -1] = pixels[::2, -1]
    valid[:half, -1] = valid[::2, -1]
    valid[half:, -1] = False
    return Recorded(recorded.name, KeyPoints(pixels, points.confidence, valid), recorded.start)


def draw(detector: Detector, actions: list[str], seeds: int, apart: bool) -> Iterator[Recorded]:
    """Yield a recording of each action and seed."""
    for action in actions:
        for seed in range(seeds):
            rng = np.random.default_rng([seed, len(action)])
            starts = rng.integers(0, LATEST if apart else 1, len(RIG))
            yield record(detector, action, seed, starts)


def time_rows(
    estimation: TimeEstimation, detector: Detector, actions: list[str], seeds: int
) -> Iterator[list[str]]:
    """Yield a row for views that started by hand, that are synchronised, and with one slow one."""
    for name, apart, slow in (
        ("by hand", True, False),
        ("synchronised", False, False),
        ("one camera at half the rate", True, True),
    ):
        within = []
        errors = [0.0]
        said = 0
        asserted = 0.0
        began = time.process_time()
        spent = 0.0
        for recorded in draw(detector, actions, seeds, apart):
            own = half_rate(recorded) if slow else recorded
            rate = np.ones(len(RIG))
            rate[-1] = 0.5 if slow else 1.0
            began = time.process_time()
            timeline = timeline_of(
                RIG.K, own.points.pixels, own.points.valid, np.arange(FRAMES), FRAMES
            )
            found = estimation(timeline, RIG.cameras)
            spent += time.process_time() - began
            determined = np.array(found.determined)
            first = int(determined.argmax())
            shift = np.array(found.shift)
            true = rate * (own.start[first] - own.start)
            error = np.abs(shift - shift[first] - true)
            within.append(error.max() <= 1)
            errors += error[determined].tolist()
            said += int(determined.sum())
            asserted = max(asserted, float(np.abs(found.clock.shift).max()))
        count = len(within)
        most = f"{asserted:.2f}" if not apart else "-"
        seconds = f"{spent / count:.1f}"
        views = f"{said} of {count * len(RIG)}"
        yield [name, f"{sum(within)} of {count}", views, f"{max(errors):.2f}", most, seconds]


def focal_rows(
    groups: dict[str, dict], detector: Detector, actions: list[str], seeds: int
) -> Iterator[list[str]]:
    """Yield a row for one focal length and for one each, from four cameras and from three."""
    calibration: RigCalibration = build(groups["calibration"], "calibration")
    rows = np.linspace(0, FRAMES - 1, 200).astype(int)
    size = torch.tensor([1000, 1002])
    for focal in ("shared", "each"):
        estimation: IntrinsicsEstimation = build(
            groups["intrinsics"] | {"focal": focal}, "intrinsics"
        )
        for views in (4, 3):
            errors = []
            z = []
            unknown = 0
            spent = 0.0
            for recorded in draw(detector, actions, seeds, False):
                own = recorded.points[rows][:, :views]
                began = time.process_time()
                found = estimation(
                    calibration,
                    estimation.guess_cameras(RIG.names[:views], size),
                    torch.from_numpy(own.pixels).double(),
                    torch.from_numpy(own.confidence).double(),
                    torch.from_numpy(own.valid),
                    0,
                )
                spent += time.process_time() - began
                if not torch.isfinite(found.std).all():
                    unknown += 1
                    continue
                error = (found.K[:, 0, 0] / RIG.K[:views, 0, 0] - 1).abs()
                errors.append(float(error.max()))
                z += (error / found.std).tolist()
            count = len(errors) + unknown
            yield [
                f"{focal}, {views} cameras",
                f"{100 * np.median(errors):.1f} / {100 * max(errors):.1f}" if errors else "-",
                f"{100 * np.mean(np.array(z) <= 2):.0f}" if z else "-",
                f"{unknown} of {count}",
                f"{spent / count:.1f}",
            ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("time", "focal"))
    parser.add_argument("--detector", default="human36m", choices=("human36m", "field"))
    parser.add_argument("--actions", nargs="*", default=list(MOVING))
    parser.add_argument("--seeds", type=int, default=1)
    arguments = parser.parse_args()
    with hydra.initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        groups = plain(hydra.compose("calibrate", ["output=unused"]))
        errs = plain(hydra.compose(f"detector/{arguments.detector}"))["detector"]
    detector = Detector(**errs)
    rest = (detector, arguments.actions, arguments.seeds)
    if arguments.what == "time":
        header = [
            "views",
            "within a frame",
            "determined",
            "largest error, frames",
            "largest shift said",
            "CPU s",
        ]
        rows = list(time_rows(build(groups["camera_check"]["time"], "time"), *rest))
    else:
        header = ["focal length", "error %, median / largest", "z <= 2, %", "not told", "CPU s"]
        rows = list(focal_rows(groups, *rest))
    print(render_markdown(Document("", [Table(header, rows)])))


if __name__ == "__main__":
    main()
