"""What a prediction is worth: the verdict, the findings that it rests on, and what to type next."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

from ghpt.calibration.check.units import unit_for
from ghpt.calibration.findings import Finding, Severity
from ghpt.calibration.mistakes import (
    FEW_VIEWS_AGREE,
    FRAME_RATE,
    LEFT_OUT_ERROR,
    LITTLE_OBSERVED,
    OUT_OF_SYNC,
    REJECTED,
    size_finding,
)
from ghpt.errors import check, check_positive


class Level(IntEnum):
    """The verdict, which is that of the worst finding."""

    GOOD = 0
    LOOK = 1
    DO_NOT_USE = 2

    @property
    def words(self) -> str:
        """The level as people read it."""
        return "look at this" if self == Level.LOOK else self.name.lower().replace("_", " ")


_LEVELS = {Severity.WARNING: Level.LOOK, Severity.ERROR: Level.DO_NOT_USE}


@dataclass(frozen=True)
class Measures:
    """What is known of a prediction; errors are medians in sizes of the person in the image."""

    stature_mm: float | None
    """None where no bone is seen."""
    held_out_error: float | None
    """Of all views; None where two views leave none out."""
    view_errors: Mapping[str, float | None]
    """Held out, or of reprojection where nothing can be; None where too little is seen."""
    rejected: float
    """The share of the joints with a position that no two views explain."""
    completeness: float
    """The share of the joints that are observed, see `Coverage.completeness`."""


@dataclass(frozen=True)
class Verdict:
    """The findings that speak against a prediction, the worst first."""

    findings: tuple[Finding, ...]
    undecidable: tuple[str, ...]
    """What the recording does not tell; it never counts against it."""

    @property
    def level(self) -> Level:
        """The level of the worst finding."""
        return max((_LEVELS[finding.severity] for finding in self.findings), default=Level.GOOD)

    def numbers(self) -> dict[str, Any]:
        """Return the verdict as plain data, with the level of each finding in words."""
        findings = [
            vars(finding) | {"level": _LEVELS[finding.severity].words} for finding in self.findings
        ]
        return {
            "level": self.level.words,
            "findings": findings,
            "undecidable": list(self.undecidable),
        }


@dataclass(frozen=True)
class Commands:
    """Complete commands on the user's own input."""

    cameras: str
    calibrate: str
    predict: Callable[..., str]
    """With these settings beside the user's own."""


@dataclass(frozen=True)
class Judge:
    """Where a number speaks against a prediction; errors are medians in sizes of the person.

    ``error``, ``wrong``: held-out errors of all views to look at, and not to use. ``views``: least
    share of the views that agree, those with an error of at most ``astray``. ``rejected``,
    ``lost``: shares of the joints with a position that are rejected to look at, and not to use.
    ``observed``: least share of the joints that are observed.
    """

    error: float
    wrong: float
    astray: float
    views: float
    rejected: float
    lost: float
    observed: float

    def __post_init__(self) -> None:
        check_positive(**vars(self))
        check(self.error <= self.wrong, "wrong", f"is {self.wrong}", "Give error or more.")
        check(self.rejected <= self.lost, "lost", f"is {self.lost}", "Give rejected or more.")

    def __call__(
        self,
        measures: Measures,
        mistakes: Sequence[Finding],
        unit_mm: float,
        commands: Commands,
    ) -> Verdict:
        """Return the verdict.

        ``mistakes``: what the camera check found; nothing where it was not asked. ``unit_mm``: the
        unit that the cameras were read in.
        """
        findings = [
            *_size(measures.stature_mm, unit_mm, commands),
            *_mistakes(mistakes, tuple(measures.view_errors), commands),
            *self._error(measures, commands),
            *self._agreement(measures, commands),
            *self._check_rejected(measures.rejected, commands),
            *self._check_observed(measures.completeness, commands),
        ]
        findings.sort(key=lambda finding: -_LEVELS[finding.severity])
        return Verdict(tuple(findings), tuple(_undecidable(measures)))

    def _error(self, measures: Measures, commands: Commands) -> Iterator[Finding]:
        known = [error for error in measures.view_errors.values() if error is not None]
        if not known:
            return
        error = measures.held_out_error
        whose = "a left-out view's"
        if error is None:  # what two views disagree by is shared among them
            error = max(known)
            whose = "the worst view's"
        if error > self.error:
            severity, limit = _grade(error, self.error, self.wrong)
            found = LEFT_OUT_ERROR.finding((), error, limit, severity, whose=whose)
            yield replace(found, command=commands.cameras)

    def _agreement(self, measures: Measures, commands: Commands) -> Iterator[Finding]:
        known = [error for error in measures.view_errors.values() if error is not None]
        if not known or measures.held_out_error is None:
            return
        agree = sum(error <= self.astray for error in known)
        share = agree / len(known)
        if share < self.views:
            found = FEW_VIEWS_AGREE.finding((), share, self.views, agree=agree, views=len(known))
            yield replace(found, command=commands.cameras)

    def _check_rejected(self, share: float, commands: Commands) -> Iterator[Finding]:
        if share > self.rejected:
            severity, limit = _grade(share, self.rejected, self.lost)
            found = REJECTED.finding((), share, limit, severity)
            yield replace(found, command=commands.cameras)

    def _check_observed(self, share: float, commands: Commands) -> Iterator[Finding]:
        if share < self.observed:
            found = LITTLE_OBSERVED.finding((), share, self.observed, Severity.WARNING)
            yield replace(found, command=commands.cameras)


def _grade(value: int | float, look: float, do_not_use: float) -> tuple[Severity, float]:
    """Return the severity of a value, and the limit that it exceeds."""
    if value > do_not_use:
        return Severity.ERROR, do_not_use
    return Severity.WARNING, look


def _undecidable(measures: Measures) -> Iterator[str]:
    if not measures.stature_mm:
        yield "the person's size, because no limb is seen"
    if all(error is None for error in measures.view_errors.values()):
        yield "the errors, because too few joints are seen by two views"
    elif measures.held_out_error is None:
        yield "the error in left-out views, which takes three views"


def _size(height: float | None, unit_mm: float, commands: Commands) -> Iterator[Finding]:
    found = size_finding(height) if height else None
    if found is not None and height:
        command = commands.predict(unit_mm=unit_for(height / unit_mm))
        yield replace(found, command=command)


def _mistakes(
    mistakes: Sequence[Finding], cameras: tuple[str, ...], commands: Commands
) -> Iterator[Finding]:
    """Yield what the camera check found, but for the size of the person, which is said already.

    Mistakes of more than half of the cameras make a prediction that is not to be used.
    """
    sizes = ("unit", "scale")
    own = [mistake for mistake in mistakes if mistake.code not in sizes or mistake.cameras]
    concerned = {name for mistake in own for name in mistake.cameras or cameras}
    severity = Severity.ERROR if 2 * len(concerned) > len(cameras) else Severity.WARNING
    for mistake in own:
        command = _command_against(mistake, cameras, commands)
        yield replace(mistake, severity=severity, command=command)


def _command_against(mistake: Finding, cameras: tuple[str, ...], commands: Commands) -> str:
    if mistake.code in (OUT_OF_SYNC.code, FRAME_RATE.code):
        return commands.predict(time="estimate")
    if mistake.mended:
        return commands.cameras
    others = [name for name in cameras if name not in mistake.cameras]
    if mistake.cameras and len(others) >= max(2, len(mistake.cameras) + 1):
        return commands.predict(views=others)
    return commands.calibrate


def verdict_lines(numbers: Mapping[str, Any]) -> list[str]:
    """Return the verdict, as `Verdict.numbers` gives it, in sentences: one for each finding, the
    verdict, and the commands to type.
    """
    lines = [
        f"{finding['level']} ({finding['code']}): {finding['text']}."
        for finding in numbers["findings"]
    ]
    if numbers["undecidable"]:
        lines.append(f"Not decidable: {'; '.join(numbers['undecidable'])}.")
    commands = dict.fromkeys(finding["command"] for finding in numbers["findings"])
    return [*lines, f"Verdict: {numbers['level']}.", *(f"Next: {command}" for command in commands)]
