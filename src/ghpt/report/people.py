"""What a test on several people reports: in the terminal, and in report.md."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ghpt.models.people import RECALL_MM, TRACKING_MM, PeopleScores, SceneScores
from ghpt.report.document import Block, Document, Heading, Paragraph, Table
from ghpt.report.tables import NAMES

_SCORES = ("PCP", "body", "mm", "rec.", "prec.", "MOTA", "IDF1", "IDs")
_CAPTION = (
    "PCP, body: correct limbs, with head and without; mm: MPJPE of the recalled",
    f"rec., prec.: recall and precision within {RECALL_MM:.0f} mm",
    f"MOTA, IDF1: within {TRACKING_MM:.0f} mm; IDs: identity switches",
)


def people_document(
    scenes: Sequence[SceneScores], scores: Mapping[str, PeopleScores], headline: str
) -> Document:
    """Return the report."""
    text = (
        "Synthetic people before cameras of Panoptic Studio. They are told apart, and each person "
        "is triangulated by a classical estimator, or followed by the trajectory of all frames. A "
        "person-frame counts where two views or more detected the person; a limb with an end that "
        "the estimator does not give counts as wrong."
    )
    blocks: list[Block] = [Paragraph(text), *_tables(scenes, scores, headline)]
    for scene in scenes:
        rows = [[_display_name(name), *_cells(each)] for name, each in scene.scores.items()]
        blocks += [Heading(scene.name), Table(("estimator", *_SCORES), rows)]
    return Document("Several people", blocks)


def people_summary(
    scenes: Sequence[SceneScores], scores: Mapping[str, PeopleScores], headline: str
) -> Document:
    """Return what the terminal shows."""
    return Document("", _tables(scenes, scores, headline))


def _tables(
    scenes: Sequence[SceneScores], scores: Mapping[str, PeopleScores], headline: str
) -> list[Block]:
    header = ("scene", "views", "found", *_SCORES)
    rows = []
    for scene in scenes:
        found = f"{scene.found} of {scene.people}"
        rows.append([scene.name, str(scene.views), found, *_cells(scene.scores[headline])])
    title = f"Several people, triangulated by {_display_name(headline)}"
    by_scene = Table(header, rows, title, _CAPTION)
    rows = [[_display_name(name), *_cells(each)] for name, each in scores.items()]
    by_estimator = Table(("all scenes by", *_SCORES), rows, "All scenes")
    return [by_scene, by_estimator]


def _cells(scores: PeopleScores) -> list[str]:
    numbers = (
        scores.pcp,
        scores.pcp_without_head,
        scores.mpjpe,
        scores.recall,
        scores.precision,
        scores.mota,
        scores.idf1,
    )
    return [*(f"{number:.1f}" for number in numbers), str(scores.switches)]


def _display_name(estimator: str) -> str:
    return NAMES.get(estimator, estimator)
