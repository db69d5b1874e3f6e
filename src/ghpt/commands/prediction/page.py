"""report.html of a prediction: the verdict, the recording over time, the rig, and the player."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from ghpt.commands.prediction.report import report_document
from ghpt.commands.prediction.result import PredictionResult
from ghpt.commands.prediction.world import World
from ghpt.export import WRITERS
from ghpt.export.scene import bones_of
from ghpt.geometry.cameras import Cameras
from ghpt.geometry.similarity import Similarity
from ghpt.geometry.upright import upright
from ghpt.reconstruction import About
from ghpt.report.course import Course
from ghpt.report.course_figure import LIMBS, ViewCourse, course_figure
from ghpt.report.document import Block, Figure, Heading, Paragraph, Player
from ghpt.report.html import write_html
from ghpt.report.rig_figure import DrawnPerson, DrawnRig, rig_figure
from ghpt.skeleton import JOINTS

_COURSE = "course"
_RIG = "rig"


@dataclass(frozen=True)
class PicturedPerson:
    """What the pictures show of a person."""

    about: About
    views: ViewCourse
    course: Course

    @property
    def drawn(self) -> DrawnPerson:
        """The person as the rig's figure shows them."""
        return DrawnPerson(self.course.points, self.course.placed, bones_of(self.about))


def limbs_of(joints: tuple[str, ...]) -> tuple[tuple[int, int], ...]:
    """Return `LIMBS` among these joints; none where some of their ends are not there."""
    if not set(JOINTS) <= set(joints):
        return ()
    return tuple((joints.index(JOINTS[a]), joints.index(JOINTS[b])) for a, b in LIMBS)


def write_page(
    output: Path,
    result: PredictionResult,
    own: PicturedPerson,
    everybody: Sequence[PicturedPerson],
    world: World,
    cameras: Cameras,
) -> None:
    """Write report.html of one of several people. ``cameras``: of the files, in their world."""
    joints = own.about.joints
    people = tuple(person.drawn for person in everybody)
    rig = DrawnRig(own.about.camera_names, cameras, people)
    figures = {
        _COURSE: course_figure(own.views, own.course, joints, result.rate_hz),
        _RIG: rig_figure("", rig, _upright(world, everybody[0], cameras)),
    }
    document = report_document(result, _blocks(result))
    write_html(output / "report.html", document, figures)


def _blocks(result: PredictionResult) -> list[Block]:
    player: list[Block] = []
    if "html" in result.formats:
        player = [Player(WRITERS["html"].file, "The 3D player in a page of its own")]
    over_time = (
        "The uppermost strip is of the frames that were evaluated, evenly spread. A view that is "
        "dark throughout has a wrong calibration, or a detector that errs in it; a dark column is "
        "a moment in which the views disagree. Left and right limbs should be as long, always."
    )
    return [
        *player,
        Heading("Over time"),
        Paragraph(over_time),
        Figure(_COURSE, "errors of the views, states of the joints and lengths of the limbs"),
        Heading("Who is where"),
        Figure(_RIG, "cameras and people from above and from the side"),
    ]


def _upright(world: World, person: PicturedPerson, cameras: Cameras) -> Similarity:
    """Return the way from the files' world to one whose z is up."""
    points = person.course.points
    placed = person.course.placed
    joints = person.about.joints
    if world.name == "people":
        return Similarity(torch.eye(3, dtype=points.dtype), 1.0, points.new_zeros(3))
    if set(JOINTS) <= set(joints):
        rows = [joints.index(name) for name in JOINTS]
        return upright(points[:, rows], placed[:, rows], cameras)
    nobody = points.new_zeros(0, len(JOINTS), 3)
    return upright(nobody, nobody[..., 0].bool(), cameras)
