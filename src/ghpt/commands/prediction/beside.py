"""What the player shows beside the prediction: the views' videos, and other estimators' poses."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import quote

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ghpt.commands.prediction.world import World
from ghpt.data.people.sequence import Sequence
from ghpt.errors import GhptDataError
from ghpt.export import OtherPoses
from ghpt.models.estimators.classical import Estimator
from ghpt.models.estimators.flips import LeftRightFlips, undo_flips
from ghpt.report.tables import NAMES
from ghpt.skeleton import BONES

_VIDEOS = (".mp4", ".webm", ".mov", ".m4v", ".mkv", ".ogv")
"""What some browser plays."""
_BATCH = 512
_log = logging.getLogger(__name__)


def find_videos(folder: Path, views: tuple[str, ...], output: Path) -> tuple[str | None, ...]:
    """Return where a page in ``output`` finds the video of each view, as an address.

    A view's video has its name, or alone has a name that contains it, that it contains, or with the
    same numbers. Raises GhptDataError without any; views without one are None, with a warning.
    """
    files = [path for path in sorted(folder.glob("*")) if path.suffix.lower() in _VIDEOS]
    found = [_find_video(files, view) for view in views]
    missing = [view for view, path in zip(views, found, strict=True) if path is None]
    if len(missing) == len(views):
        problem = f"has no {' or '.join(_VIDEOS)} with the name of a view ({', '.join(views)})"
        raise GhptDataError(folder, "videos", problem, "Name the videos like the views.")
    if missing:
        _log.warning("No video of %s in %s.", ", ".join(missing), folder)
    return tuple(None if path is None else _address(path, output) for path in found)


def _find_video(files: list[Path], view: str) -> Path | None:
    same = [path for path in files if path.stem == view]
    alike = [path for path in files if view in path.stem or path.stem in view]
    numbered = [path for path in files if _numbers(view) and _numbers(path.stem) == _numbers(view)]
    candidates = same or alike or numbered
    return candidates[0] if len(candidates) == 1 else None


def _numbers(name: str) -> list[int]:
    return [int(digits) for digits in re.findall(r"\d+", name)]


def _address(path: Path, output: Path) -> str:
    return quote(Path(os.path.relpath(path.resolve(), output.resolve())).as_posix())


def compared_poses(
    sequence: Sequence,
    estimators: Mapping[str, Estimator],
    flips: LeftRightFlips | None,
    fitted_frames: int,
    world: World,
) -> tuple[OtherPoses, ...]:
    """Return the 17 joints of each of the estimators, in the files' world; none where the
    detector does not give them.
    """
    if not sequence.skeleton.has_joints:
        return ()
    joints = sequence.as_joints()
    own_flips = flips and flips.for_skeleton(joints.skeleton)
    sample = joints.read(joints.spread(fitted_frames))
    found = []
    for name, estimator in estimators.items():
        poses = _Poses(joints, estimator.fit_to(sample), own_flips, world)
        found.append(OtherPoses(NAMES.get(name, name), BONES, poses))
    return tuple(found)


class _Poses:
    """The poses of an estimator at frame numbers."""

    def __init__(
        self,
        sequence: Sequence,
        estimator: Estimator,
        flips: LeftRightFlips | None,
        world: World,
    ) -> None:
        self.sequence = sequence
        self.estimator = estimator
        self.flips = flips
        self.world = world

    @torch.no_grad()
    def __call__(self, frames: Int[Tensor, " T"]) -> Float[Tensor, "T 17 3"]:
        """Return the poses, mm; NaN where a joint is not estimated."""
        rows = torch.searchsorted(torch.from_numpy(self.sequence.frame), frames)
        return torch.cat([self._estimate(part) for part in rows.split(_BATCH)])

    def _estimate(self, rows: Int[Tensor, " B"]) -> Float[Tensor, "B 17 3"]:
        batch = self.sequence.read(rows.numpy())
        if self.flips is not None:
            batch, _ = undo_flips(batch, self.flips)
        found = self.estimator(batch)
        points = found.points.double() + self.sequence.origin
        if self.world.name != "cameras":
            points = self.world.change.points(points)
        return torch.where(found.estimated[..., None], points, torch.nan)
