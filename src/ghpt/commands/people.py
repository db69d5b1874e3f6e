"""Testing on several people: told apart, triangulated and followed, beside the truth.

The test needs no checkpoint: the estimators are the classical ones and the trajectory.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ghpt.commands.display import display_path
from ghpt.commands.trainer import make_trainer, progress
from ghpt.config import Target, build
from ghpt.data.datasets.people import People
from ghpt.errors import GhptConfigError, check
from ghpt.extras import build_installed
from ghpt.files import write_json
from ghpt.models.estimators.trajectory.tested import TestedTrajectory
from ghpt.models.people import TRAJECTORY, PeopleScores, PeopleTriangulation, SceneScores
from ghpt.provenance import provenance
from ghpt.report.markdown import write_markdown
from ghpt.report.people import people_document, people_summary
from ghpt.report.terminal import print_document

_DATA = f"{People.__module__}.{People.__qualname__}"
_OF_FRAMES = "adaptive_ransac"
"""The estimator that is shown for each scene where the trajectory is left out."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PeopleResult:
    """What a test on several people measured."""

    scenes: tuple[SceneScores, ...]
    scores: dict[str, PeopleScores]
    """Each estimator's numbers of all scenes together."""
    provenance: dict[str, Any]

    @property
    def headline(self) -> str:
        """The name of the estimator that is shown for each scene."""
        wanted = [name for name in (TRAJECTORY, _OF_FRAMES) if name in self.scores]
        return next(iter([*wanted, *self.scores]))

    @property
    def words(self) -> str:
        """The result in one line."""
        total = self.scores[self.headline]
        return f"PCP {total.pcp:.1f} %, {total.mpjpe:.1f} mm, {total.switches} identity switches"

    def plain(self) -> dict[str, Any]:
        """Return the content of metrics.json."""
        scenes = {
            scene.name: {
                "views": scene.views,
                "frames": scene.frames,
                "people": scene.people,
                "found": scene.found,
                "estimators": {name: each.plain() for name, each in scene.scores.items()},
            }
            for scene in self.scenes
        }
        return {
            "estimators": {name: each.plain() for name, each in self.scores.items()},
            "scenes": scenes,
            "provenance": self.provenance,
        }


def is_of_people(data: Target) -> bool:
    """Return whether a test's data are recordings of several people."""
    return data.get("_target_") == _DATA


def test_people(
    data: Target,
    baselines: Target,
    trajectory: Target | None,
    trainer: Target,
    ckpt: str | None,
    seed: int,
    progress_bar: bool,
    output: Path,
) -> PeopleResult:
    """Tell the people of each recording apart, triangulate them and compare them with the truth.

    ``trajectory``: of each person's frames together; None: the ``baselines`` alone.
    Writes metrics.json and report.md into ``output`` and prints the tables.
    """
    if ckpt:
        hint = "Leave ckpt out: the classical estimators are tested."
        raise GhptConfigError("ckpt", "is not for several people", hint)
    check(len(baselines) > 0, "baselines", "is empty", "Leave one in.")
    estimators = build_installed(baselines, "baselines")
    recordings = build(data, "data")
    tested: TestedTrajectory | None = build(trajectory, "trajectory") if trajectory else None
    module = PeopleTriangulation(estimators, tested.trajectory if tested else None)
    run = make_trainer(
        {**trainer, "accelerator": "cpu", "devices": 1},
        default_root_dir=output,
        logger=False,
        callbacks=progress(progress_bar),
        enable_progress_bar=progress_bar,
    )
    run.test(module, datamodule=recordings, verbose=False)
    result = PeopleResult(tuple(module.scenes), module.scores(), provenance(seed))
    write_json(output / "metrics.json", result.plain())
    document = people_document(result.scenes, result.scores, result.headline)
    write_markdown(output / "report.md", document)
    print_document(people_summary(result.scenes, result.scores, result.headline))
    path = display_path(output / "report.md")
    _log.info("Report: %s, beside it metrics.json.", path)
    return result


test_people.__test__ = False  # type: ignore[attr-defined]  # not one for pytest
