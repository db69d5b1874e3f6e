"""What a prediction is worth: the verdict, the numbers that it rests on, and what to type next."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import IntEnum
from typing import Any

from ghpt.calibration.check.examination import Checkup
from ghpt.calibration.check.examination import Finding as Mistake
from ghpt.calibration.check.units import unit_for
from ghpt.errors import check, check_positive
from ghpt.models.relative_pose.scale import HUMAN, STATURES

Numbers = dict[str, Any]


class Level(IntEnum):
    """The worst finding makes the verdict."""

    GOOD = 0
    LOOK = 1
    DO_NOT_USE = 2

    @property
    def words(self) -> str:
        return self.name.lower().replace("_", " ") if self != Level.LOOK else "look at this"


@dataclass(frozen=True)
class Finding:
    """One thing that speaks against a prediction."""

    code: str
    level: Level
    text: str
    """A sentence without its full stop."""
    value: float
    limit: float
    """What ``value`` was held against; 0 for a finding of the camera check."""
    command: str
    """What to type next."""


@dataclass(frozen=True)
class Verdict:
    """``undecidable``: what the recording does not tell; it never counts against it."""

    findings: tuple[Finding, ...]
    undecidable: tuple[str, ...]

    @property
    def level(self) -> Level:
        return max((finding.level for finding in self.findings), default=Level.GOOD)

    def numbers(self) -> Numbers:
        """As plain data."""
        findings = [asdict(finding) | {"level": finding.level.words} for finding in self.findings]
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
    """Where a number speaks against a prediction; errors are medians in sizes of the person in the
    image.

    ``clean``: with a smaller error in every view the camera check is not asked. ``many``: with more
    views it is asked only if a view's error exceeds ``suspicious``, because its time grows with
    their square. ``error``, ``wrong``: errors of all views in left-out views to look at, and not to
    use. ``views``: least share of the views that agree, those with an error of at most ``astray``.
    ``rejected``, ``lost``: shares of the placed joints that are rejected to look at, and not to
    use.
    """

    clean: float
    many: int
    suspicious: float
    error: float
    wrong: float
    astray: float
    views: float
    rejected: float
    lost: float

    def __post_init__(self) -> None:
        check_positive(**vars(self))
        check(self.error <= self.wrong, "wrong", f"is {self.wrong}", "Give error or more.")
        check(self.rejected <= self.lost, "lost", f"is {self.lost}", "Give rejected or more.")

    def asks(self, errors: Mapping[str, float | None]) -> bool:
        """Whether the camera check is worth its time. ``errors``: of each view, None where nothing
        tells it.
        """
        limit = self.clean if len(errors) <= self.many else self.suspicious
        return any(error is None or error > limit for error in errors.values())

    def __call__(
        self, numbers: Numbers, checkup: Checkup | None, unit_mm: float, commands: Commands
    ) -> Verdict:
        """``numbers``: what `predict` knows of the recording. ``unit_mm``: the unit that the
        cameras were read in.
        """
        undecidable: list[str] = []
        mistakes = () if checkup is None else checkup.findings
        findings = [
            *self._size(numbers["stature_mm"], unit_mm, commands, undecidable),
            *self._mistakes(mistakes, numbers["cameras"], commands),
            *self._errors(numbers["scales"], commands, undecidable),
            *self._rejected(numbers["share"], commands),
        ]
        findings.sort(key=lambda finding: -finding.level)
        return Verdict(tuple(findings), tuple(undecidable))

    @staticmethod
    def _size(
        height: float | None, unit_mm: float, commands: Commands, undecidable: list[str]
    ) -> Iterator[Finding]:
        if not height:
            undecidable.append("the person's size, because no limb is seen")
            return
        low, high = STATURES
        if low <= height <= high:
            return
        human = HUMAN[0] <= height <= HUMAN[1]
        text = (
            f"the person measures {height / 1000:,.2f} m, and people measure {low / 1000:g} to {high / 1000:g} m: "
            "the cameras' unit of length is another, or their scale is wrong"
        )
        command = commands.predict(unit_mm=unit_for(height / unit_mm))
        level = Level.LOOK if human else Level.DO_NOT_USE
        yield Finding("size", level, text, height, low if height < low else high, command)

    def _errors(
        self, scales: Numbers, commands: Commands, undecidable: list[str]
    ) -> Iterator[Finding]:
        views = {view: error for view, error in scales["views"].items() if error is not None}
        if not views:
            undecidable.append("the errors, because too few joints are seen by two views")
            return
        error = scales["all"]
        whose = "a left-out view's"
        if error is None:  # two views leave none: what they disagree by is shared among them
            undecidable.append("the error in left-out views, which takes three views")
            error = max(views.values())
            whose = "the worst view's"
        if error > self.error:
            text = f"{whose} key points lie {error:.1%} of the person's size from the joints"
            level = Level.DO_NOT_USE if error > self.wrong else Level.LOOK
            limit = self.wrong if error > self.wrong else self.error
            yield Finding("left_out_error", level, text, error, limit, commands.cameras)
        if scales["all"] is None:
            return
        agree = sum(value <= self.astray for value in views.values())
        if agree < self.views * len(views):
            text = f"{agree} of {len(views)} views agree with the others"
            share = agree / len(views)
            yield Finding(
                "few_views_agree", Level.DO_NOT_USE, text, share, self.views, commands.cameras
            )

    def _rejected(self, share: Mapping[str, float], commands: Commands) -> Iterator[Finding]:
        placed = share["rejected"] + share["observed"]
        part = share["rejected"] / placed if placed else 0.0
        if part > self.rejected:
            text = f"no two views explain {part:.1%} of the joints, which were rejected"
            level = Level.DO_NOT_USE if part > self.lost else Level.LOOK
            limit = self.lost if part > self.lost else self.rejected
            yield Finding("rejected", level, text, part, limit, commands.cameras)

    @staticmethod
    def _mistakes(
        mistakes: Sequence[Mistake], cameras: Sequence[str], commands: Commands
    ) -> Iterator[Finding]:
        """What the camera check says, but for the size, which is said already."""
        mistakes = [
            mistake
            for mistake in mistakes
            if mistake.code not in ("unit", "scale") or mistake.cameras
        ]
        concerned = {name for mistake in mistakes for name in mistake.cameras or cameras}
        most = 2 * len(concerned) > len(cameras)
        for mistake in mistakes:
            others = [name for name in cameras if name not in mistake.cameras]
            command = commands.cameras
            if not mistake.mended:
                leave_out = mistake.cameras and len(others) >= 2
                command = commands.predict(views=others) if leave_out else commands.calibrate
            level = Level.DO_NOT_USE if most else Level.LOOK
            yield Finding(mistake.code, level, mistake.text, mistake.value, 0.0, command)


def verdict_lines(numbers: Numbers) -> list[str]:
    """The verdict as `Verdict.numbers` gives it: a sentence for each finding, then what to type,
    the first first.
    """
    lines = [
        f"{finding['level']} ({finding['code']}): {finding['text']}."
        for finding in numbers["findings"]
    ]
    if numbers["undecidable"]:
        lines.append(f"Not decidable: {'; '.join(numbers['undecidable'])}.")
    commands = dict.fromkeys(finding["command"] for finding in numbers["findings"])
    return [*lines, f"Verdict: {numbers['level']}.", *(f"Next: {command}" for command in commands)]
