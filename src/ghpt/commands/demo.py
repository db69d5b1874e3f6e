"""A demonstration without any file: from a synthetic recording to cameras, poses and the player."""

from __future__ import annotations

import logging
import shlex
import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ghpt.commands.app import Command, quieten
from ghpt.commands.catalogue import load, run_by_name
from ghpt.commands.display import as_started, display_path, shell_override
from ghpt.commands.outputs import Files, OutputFolder, OutputSettings
from ghpt.commands.overrides import Source, compose
from ghpt.config import CONF, plain, suggest
from ghpt.config import settings as typed_settings
from ghpt.data.formats.camera_writers import write_pose2sim
from ghpt.data.formats.own_npz import write_key_points
from ghpt.data.points import KeyPoints
from ghpt.data.synthetic.actions import action_names
from ghpt.data.synthetic.body import stature
from ghpt.data.synthetic.detector import Detector
from ghpt.data.synthetic.recordings import draw_motion
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.errors import check
from ghpt.export import WRITERS
from ghpt.geometry.lens import distort
from ghpt.skeleton import JOINTS

KEY_POINTS = "recording/key_points.npz"
CAMERAS = "recording/cameras.toml"
_SUBJECT = "S9"
_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class DemoSettings(OutputSettings):
    """The settings of `demo`."""

    seconds: float
    """Length of the recording."""
    action: str
    """What the person does: one of the actions of Human3.6M."""
    rate_hz: float
    detector: dict[str, Any]
    """The model of a detector that errs."""
    seed: int
    browser: bool
    """Whether the player is opened at the end."""
    progress_bar: bool

    def __post_init__(self) -> None:
        enough = self.seconds * self.rate_hz >= 100
        check(enough, "seconds", f"is {self.seconds}", "Give 100 frames or more: seconds=10.")
        known = self.action in action_names()
        check(known, "action", f"is {self.action!r}", suggest(self.action, action_names()))


@dataclass(frozen=True)
class DemoResult:
    """The files of a demonstration."""

    key_points: Path
    cameras: Path
    rig: Path
    poses: Path
    player: Path


def files(settings: DemoSettings) -> Files:
    """Return what a demonstration writes; its parts guard their own folders."""
    return Files(writes=(KEY_POINTS, CAMERAS))


def demo(settings: DemoSettings, output: Path) -> DemoResult:
    """Record a synthetic person, calibrate the cameras from them, and predict their 3D poses.

    The recording is written as files of a user's own would be. What is typed to work on them is
    printed, and done: the commands are those of `ghpt.commands.calibrate` and `predict`.
    """
    result = DemoResult(
        key_points=output / KEY_POINTS,
        cameras=output / CAMERAS,
        rig=output / "rig",
        poses=output / "poses",
        player=output / "poses" / WRITERS["html"].file,
    )
    _log.info("1. A synthetic person before Human3.6M's four cameras, seen by a detector that errs")
    height = _record(settings, result)
    _log.info("   %s, %s", display_path(result.key_points), display_path(result.cameras))
    _log.info("\n2. The cameras, from the person alone: their extrinsics are only compared with")
    inputs = [shell_override("keypoints", display_path(result.key_points))]
    words = [
        *inputs,
        shell_override("cameras", display_path(result.cameras)),
        f"scale.height={height:.0f}",
        shell_override("output", display_path(result.rig)),
    ]
    _perform("calibrate", words, settings)
    _log.info("\n3. The person in 3D, by those cameras")
    words = [
        *inputs,
        shell_override("cameras", display_path(result.rig / "rig.toml")),
        "world=people",
        shell_override("output", display_path(result.poses)),
    ]
    _perform("predict", words, settings)
    _say_next(result)
    if settings.browser:
        webbrowser.open(result.player.resolve().as_uri())
    return result


def summary(result: DemoResult) -> str:
    """Return the result in one line."""
    return display_path(result.player)


def _record(settings: DemoSettings, files: DemoResult) -> float:
    """Write the recording's two files. Returns the person's height, mm."""
    rig = human36m_rig(_SUBJECT)
    take = f"{_SUBJECT}/{settings.action}-demo"
    frames = round(settings.seconds * settings.rate_hz)
    truth = draw_motion(settings.seed, _SUBJECT, take, settings.action, frames, settings.rate_hz)
    detector = Detector(**settings.detector)
    found = detector(truth, rig, settings.rate_hz, settings.seed, _SUBJECT, take, False)
    ideal = torch.from_numpy(found.key_points).double().transpose(0, 1)
    seen = distort(ideal.flatten(1, 2), rig.cameras.K, rig.distortion).reshape(ideal.shape)
    pixels = seen.transpose(0, 1).numpy()
    pixels[~found.valid] = np.nan
    points = KeyPoints(
        pixels=pixels.astype(np.float32),
        confidence=found.confidence.astype(np.float32),
        valid=found.valid,
    )
    files.key_points.parent.mkdir(parents=True, exist_ok=True)
    numbers = np.arange(frames)
    write_key_points(files.key_points, rig.names, JOINTS, numbers, points, settings.rate_hz)
    write_pose2sim(files.cameras, rig, {})
    return stature(truth)


def _perform(name: str, words: Sequence[str], settings: DemoSettings) -> Any:
    """Print a command as it is typed, and do what it does."""
    typed = as_started(f"python {name}.py")
    _log.info("   $ %s %s\n", typed, " ".join(words))
    command = load(name, CONF)
    quieten()
    values = plain(compose(Source(CONF, name), shlex.split(" ".join(words))))
    values |= {"overwrite": settings.overwrite}
    own = typed_settings(command.settings, values)
    folder = Path(own.output)
    with OutputFolder(folder, command.files(own), own.overwrite):
        return command.task(own, folder)


def _say_next(result: DemoResult) -> None:
    _log.info("\nLook at it: open %s in a browser.", display_path(result.player))
    example = "keypoints=pose/ cameras=Calib.toml output=out/"
    _log.info("Your own recording: %s %s", as_started("python predict.py"), example)


COMMAND = Command(name="demo", settings=DemoSettings, task=demo, summary=summary, files=files)


if __name__ == "__main__":
    run_by_name("demo")
