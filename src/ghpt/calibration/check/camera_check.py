"""The camera check: undoes each mistake, keeps what clearly brings the views together, and looks
again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.calibration.check.agreement import Agreement, triangulate_choices
from ghpt.calibration.check.evidence import Evidence
from ghpt.calibration.check.search import Search, Thresholds
from ghpt.calibration.check.setup import RayCache, Setup
from ghpt.calibration.check.units import unit_of
from ghpt.calibration.findings import Finding
from ghpt.calibration.mistakes import (
    LENS,
    MOVED,
    MOVED_ONE_OF,
    NOTHING_AGREES,
    OFF,
    OUT_OF_SYNC,
    UNIT,
    Candidate,
    size_finding,
)
from ghpt.calibration.moved import RigChange
from ghpt.calibration.rig import RigCalibration, RigEstimate
from ghpt.calibration.time.estimation import TimeEstimation
from ghpt.errors import check, check_positive
from ghpt.geometry.cameras import Cameras
from ghpt.models.estimators.classical import Estimator
from ghpt.models.relative_pose.scale import stature

_LEAST_VIEWS = 3
"""Of two cameras nobody can say which has moved."""


@dataclass(frozen=True)
class CameraCheckResult:
    """What the camera check found."""

    findings: tuple[Finding, ...]
    """In the order in which the mistakes were undone."""
    setup: Setup
    """With every mistake undone that can be."""
    error_px: Float[Tensor, " V"]
    """The held-out error of each view after that: median, pixels."""
    given_px: Float[Tensor, " V"]
    """The same as the files have it."""
    course_px: Float[Tensor, "F V"]
    """The held-out error in each frame, NaN where nothing is compared: as ``error_px``."""
    given_course_px: Float[Tensor, "F V"]
    """The same as the files have it."""
    stature: float
    """Of the person, mm; 0 where it was not measured."""
    unit_mm: float | None
    """The unit of the file, mm, where the file does not say it and the person tells."""
    points: Float[Tensor, "F J 3"]
    """The person before the cameras of ``setup``, mm."""
    estimated: Bool[Tensor, "F J"]


@dataclass(frozen=True)
class CameraCheck:
    """The settings of the camera check; errors are held-out medians in sizes of the person.

    ``frames``: most frames looked at. ``shift``: largest shift in time that is tried, frames.
    ``rounds``: most mistakes in one recording. ``astray``: a view with a larger error, which
    nothing mends, is off. ``clean``: where the error of every view is smaller, predict.py does not
    ask. ``contrast``: the repair of a view is kept if it leaves at most so many times the median
    error of the others, or ``repaired``. ``many``: of more views it asks only if a view's error
    exceeds ``suspicious``, because the time grows with their square. ``consensus``: estimator that
    the person is measured with. ``time``: of the views, which is looked at before anything else.
    ``rig``: the calibration of all cameras from the people, which tells whether a camera that does
    not fit the others is the one that has moved.
    """

    frames: int
    shift: int
    rounds: int
    astray: float
    clean: float
    contrast: float
    repaired: float
    many: int
    suspicious: float
    thresholds: Thresholds
    consensus: Estimator
    time: TimeEstimation
    rig: RigCalibration

    def __post_init__(self) -> None:
        check_positive(
            frames=self.frames,
            rounds=self.rounds,
            astray=self.astray,
            clean=self.clean,
            contrast=self.contrast,
            repaired=self.repaired,
            many=self.many,
            suspicious=self.suspicious,
        )
        check(self.shift >= 0, "shift", f"is {self.shift}", "It must not be negative.")

    def is_worthwhile(self, errors: Mapping[str, float | None]) -> bool:
        """Return whether the check is worth its time.

        ``errors``: of each view, sizes of the person; None where nothing tells it.
        """
        limit = self.clean if len(errors) <= self.many else self.suspicious
        return any(error is None or error > limit for error in errors.values())

    @torch.no_grad()
    def __call__(
        self, evidence: Evidence, setup: Setup, estimate: RigEstimate | None = None
    ) -> CameraCheckResult:
        """Return what is wrong with the cameras, and the setup with it undone.

        ``estimate``: of the rig, from the people in view; without one it is calibrated where a
        camera seems to have moved.
        """
        cache = RayCache(evidence)
        search = Search(cache, setup, self.thresholds)
        given_px = pixels_of(cache, setup, search.now.error)
        given_course_px = pixels_of(cache, setup, search.now.course)
        findings: list[Finding] = []
        shared = setup
        for _ in range(self.rounds):
            best = search.best()
            if best is None:
                break
            candidate, after = best
            shared = _undo_shared(shared, candidate)
            findings.append(_undone(search, candidate, after))
            search = search.after(candidate, after)
        partly = self._partly_repaired(search, findings)
        if partly:
            given_back = _restore_given(search.setup, shared, partly)
            search = Search(cache, given_back, self.thresholds)
            findings = [_as_unrepaired(found, partly, evidence.names) for found in findings]
        named = self._ambiguous_moves(search, shared, findings, estimate)
        if named:
            given_back = _restore_given(search.setup, shared, set(named))
            search = Search(cache, given_back, self.thresholds)
            findings = [_as_one_of(found, named, evidence.names) for found in findings]
        findings += self._unrepaired_views(search, set(named))
        height = self._stature(search)
        setup, height, unit_mm = _file_unit(search.setup, height)
        wrong_size = size_finding(height) if height else None
        result = list(merge_steps(findings))
        if wrong_size is not None:
            mended = wrong_size.code == UNIT.code
            result.append(replace(wrong_size, mended=mended))
            if mended:
                setup = replace(setup, t=wrong_size.value * setup.t)
                height *= wrong_size.value
        error_px = pixels_of(cache, setup, search.now.error)
        agrees = search.now.error < self.thresholds.level
        used = search.now.core if bool(agrees.any()) else torch.ones_like(agrees)
        points, known = triangulate_choices(cache.all(setup), setup, used[None], self.consensus)
        return CameraCheckResult(
            findings=tuple(result),
            setup=setup,
            error_px=error_px,
            given_px=given_px,
            course_px=pixels_of(cache, setup, search.now.course),
            given_course_px=given_course_px,
            stature=height,
            unit_mm=unit_mm,
            points=points[0],
            estimated=known[0],
        )

    def _partly_repaired(self, search: Search, findings: list[Finding]) -> set[int]:
        """Return the views that were repaired and are still worse than the others.

        What was undone there is not what is wrong, or not all of it: a camera that runs at another
        rate looks as if it had moved, and would be moved by metres.
        """
        names = list(search.cache.evidence.names)
        repaired = {names.index(name) for found in findings for name in found.cameras}
        error = search.now.error
        partly = set()
        for view in repaired:
            others = torch.cat((error[:view], error[view + 1 :]))
            limit = max(self.contrast * float(others.median()), self.repaired)
            if float(error[view]) > limit:
                partly.add(view)
        for found in findings:  # two views that were exchanged are so together
            views = {names.index(name) for name in found.cameras}
            if views & partly:
                partly |= views
        return partly

    def _ambiguous_moves(
        self, search: Search, given: Setup, findings: list[Finding], estimate: RigEstimate | None
    ) -> dict[int, tuple[int, ...]]:
        """Return the views that seem to have moved although another one may have as well, and
        which these are.

        A camera is held against the others as the file has them. Whether these are right only a
        rig tells in which all cameras are free, as far as its ± allow. ``given``: the file's
        cameras with the mistakes that all of them share undone.
        """
        names = search.cache.evidence.names
        moves = {
            names.index(found.cameras[0])
            for found in findings
            if found.code == MOVED.code and found.mended
        }
        if not moves or len(names) < _LEAST_VIEWS:
            return {}
        rig = self._free_rig(search) if estimate is None else estimate
        if not bool(rig.calibrated.all()):
            return {}
        before = _restore_given(search.setup, given, moves)
        change = RigChange.of(rig, Cameras(before.K, before.R, before.t))
        suspects = {view: change.suspects(view, moves - {view}) for view in moves}
        return {view: those for view, those in suspects.items() if len(those) > 1}

    def _free_rig(self, search: Search) -> RigEstimate:
        """Return the rig that the key points show without any extrinsics."""
        rays = search.cache.all(search.setup)
        K = search.setup.K
        pixels = rays.xy.transpose(0, 1) @ K[:, :2, :2].mT + K[:, None, :2, 2]
        valid = rays.valid.transpose(0, 1)
        evidence = search.cache.evidence
        names = evidence.names
        return self.rig(names, K, pixels, valid.double(), valid, None, 0, evidence.frame)

    def _unrepaired_views(self, search: Search, named: set[int]) -> list[Finding]:
        """Return the views that nothing that was tried brings to the others, but those that a
        finding has named.
        """
        error = search.now.error
        pixels = pixels_of(search.cache, search.setup, error)
        off = error > self.astray
        if bool(off.all()):
            mean = float(pixels.mean())
            found = NOTHING_AGREES.finding()
            return [replace(found, before_px=mean, after_px=mean)]
        findings = []
        for view in set(torch.nonzero(off)[:, 0].tolist()) - named:
            name = search.cache.evidence.names[view]
            found = OFF.finding((name,), float(error[view]), self.astray)
            own = float(pixels[view])
            findings.append(replace(found, before_px=own, after_px=own))
        return findings

    def _stature(self, search: Search) -> float:
        """Return the stature (mm) of the person that the agreeing views show together, measured as
        every command measures it; 0 where no views agree.
        """
        agrees = search.now.error < self.thresholds.level
        if not bool(agrees.any()):
            return 0.0
        rays = search.cache.all(search.setup)
        core = search.now.core[None]
        points, known = triangulate_choices(rays, search.setup, core, self.consensus)
        return float(stature(points[0], known[0]))


def pixels_of(cache: RayCache, setup: Setup, error: Float[Tensor, "*F V"]) -> Float[Tensor, "*F V"]:
    """Return the errors of the views, in sizes of the person, as pixels."""
    size = cache.all(setup).size
    typical = torch.where(size > 0, size, torch.nan).nanmedian(-1).values.nan_to_num(0.0)
    focal = (setup.K[:, 0, 0] * setup.K[:, 1, 1]).sqrt()
    return error * typical * focal


def merge_steps(findings: list[Finding]) -> list[Finding]:
    """Merge the findings of a camera that was put right in two steps of one kind.

    The last word counts, and of two rotations the larger; the error before is the first one's.
    """
    result: list[Finding] = []
    for found in findings:
        earlier = [
            number
            for number, old in enumerate(result)
            if (old.code, old.cameras) == (found.code, found.cameras)
        ]
        if not earlier or found.code not in (OUT_OF_SYNC.code, MOVED.code, LENS.code):
            result.append(found)
            continue
        old = result[earlier[0]]
        told = old if found.code == MOVED.code and old.value > found.value else found
        result[earlier[0]] = replace(told, before_px=old.before_px, after_px=found.after_px)
    return result


def _undo_shared(setup: Setup, candidate: Candidate) -> Setup:
    """Return the setup with the candidate's mistake undone, if it is one of all cameras."""
    undo = candidate.mistake.undo
    if candidate.views or undo is None:
        return setup
    return undo(setup, tuple(range(len(setup))), candidate.value)


def _restore_given(setup: Setup, given: Setup, views: set[int]) -> Setup:
    """Return the setup with some views as the files have them."""
    names = [field.name for field in fields(Setup) if field.name != "unit_mm"]
    for view in views:
        setup = setup.replace_camera(view, **{name: getattr(given, name)[view] for name in names})
    return setup


def _as_unrepaired(found: Finding, views: set[int], names: tuple[str, ...]) -> Finding:
    """Return the finding as of a mistake that was not undone, if it is about one of the views."""
    if not any(names.index(name) in views for name in found.cameras):
        return found
    return replace(found, mended=False, after_px=found.before_px)


def _as_one_of(
    found: Finding, suspects: dict[int, tuple[int, ...]], names: tuple[str, ...]
) -> Finding:
    """Return the finding of a camera that has moved as one of several that may have."""
    views = {names.index(name) for name in found.cameras}
    ambiguous = views & set(suspects)
    if not ambiguous:
        return found
    if found.code != MOVED.code:
        return replace(found, mended=False, after_px=found.before_px)
    those = tuple(names[view] for view in suspects[ambiguous.pop()])
    told = MOVED_ONE_OF.finding(those, found.value)
    return replace(told, before_px=found.before_px, after_px=found.before_px)


def _undone(search: Search, candidate: Candidate, after: Agreement) -> Finding:
    """Return the finding of a mistake that was undone, with the errors before and after."""
    names = tuple(search.cache.evidence.names[view] for view in candidate.views)
    views = list(candidate.views) or slice(None)
    before = pixels_of(search.cache, search.setup, search.now.error)[views]
    then = pixels_of(search.cache, candidate.setup, after.error)[views]
    return replace(
        candidate.mistake.finding(names, candidate.value),
        before_px=float(before.mean()),
        after_px=float(then.mean()),
        mended=True,
    )


def _file_unit(setup: Setup, height: float) -> tuple[Setup, float, float | None]:
    """Return the setup and the person's height in mm, and the file's unit where the person tells
    it because the file does not.
    """
    if not height or setup.unit_mm is None:
        return setup, height, None
    unit = unit_of(height / setup.unit_mm)
    if unit is None:
        return setup, height, None
    factor = unit / setup.unit_mm
    return replace(setup, t=factor * setup.t, unit_mm=None), factor * height, unit
