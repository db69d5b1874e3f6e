"""The doctor: tries each mistake undone, keeps what clearly brings the views together, and looks
again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from ghpt.calibration.check.agreement import (
    LARGEST,
    Agreement,
    agreement,
    all_pairs,
    errors,
    median,
    pair_errors,
    triangulated,
)
from ghpt.calibration.check.candidates import (
    RATES,
    UNITS,
    Candidate,
    at_rate,
    exchanged,
    of_file,
    of_view,
    shifted,
)
from ghpt.calibration.check.evidence import Evidence
from ghpt.calibration.check.resection import resect
from ghpt.calibration.check.setup import Look, Setup
from ghpt.calibration.check.units import unit_of
from ghpt.errors import check
from ghpt.geometry.cameras import camera_centre
from ghpt.metrics.relative_pose import rotation_deg
from ghpt.models.estimators.classical import Estimator, MEstimator
from ghpt.models.relative_pose.scale import STATURES, stature

_FEW = 80
"""Key points, of which a quarter gives a median."""
_FITTED_LENS = 0.85
"""A lens that was fitted must explain so much more than none."""

_ONE_FRAME = 0.85
"""A shift by one frame must explain so much more than a longer one: cameras without a trigger are
half a frame off.
"""


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong."""

    code: str
    cameras: tuple[str, ...]
    """Empty: all alike."""
    text: str
    value: float
    """The mistake's own number: frames, ratio, k1, degrees; 0 where it has none."""
    before_px: float
    """Held-out error of the cameras it is about (median, pixels) as it was."""
    after_px: float
    """... and once undone; as before where nothing mends it."""
    mended: bool


@dataclass(frozen=True)
class Checkup:
    """All findings, in the order in which they were mended."""

    findings: tuple[Finding, ...]
    setup: Setup
    """With everything undone that could be."""
    error_px: Float[Tensor, " V"]
    """Held-out error of each view after that, pixels."""
    given_px: Float[Tensor, " V"]
    """... and as the files had it."""
    stature: float
    """Of the person, mm; 0 where it was not measured."""
    unit_mm: float | None = None
    """The unit of the file, where it does not say it and the person tells."""


@dataclass(frozen=True)
class Doctor:
    """Settings of the examination; errors are held-out medians in sizes of the person in the image.

    ``level``: largest error of a view that agrees. ``discrete``, ``shifted``, ``lens``, ``lenses``,
    ``fitted``: what the undoing of a mistake must leave at most of the error of the views it is
    about: of one of few possibilities, a shift in time, one camera's lens, all lenses, and a
    camera's place. ``least``: and by how much it must lessen it. ``astray``: a view that stays
    worse than this is said to be off. ``rated``: other frame rates are tried for a view that is
    worse. ``pairs``: most pairs of views tried. ``rounds``: most mistakes in one recording.
    ``consensus``: what the person is measured with.
    """

    frames: int
    shift: int
    level: float
    discrete: float
    shifted: float
    lens: float
    lenses: float
    fitted: float
    least: float
    astray: float
    rated: float
    pairs: int
    rounds: int
    estimator: MEstimator
    consensus: Estimator

    def __post_init__(self) -> None:
        for name in ("discrete", "shifted", "lens", "lenses", "fitted"):
            check(
                0 < getattr(self, name) < 1,
                name,
                f"is {getattr(self, name)}",
                "It must lie between 0 and 1.",
            )
        for name in ("frames", "level", "astray", "pairs", "rounds"):
            check(getattr(self, name) > 0, name, f"is {getattr(self, name)}", "It must be > 0.")
        check(self.shift >= 0, "shift", f"is {self.shift}", "It must not be negative.")

    @torch.no_grad()
    def __call__(self, evidence: Evidence, setup: Setup) -> Checkup:
        look = Look(evidence)
        now = self._agreement(look, setup)
        given = self._pixels(look, setup, now.error)
        findings: list[Finding] = []
        for _ in range(self.rounds):
            chosen = self._best(look, setup, now)
            if chosen is None:
                break
            candidate, after = chosen
            findings = [*findings, self._finding(look, setup, candidate, now, after)]
            setup = candidate.setup
            now = after
        findings += self._left(look, setup, now)
        height = self._stature(look, setup, now)
        setup, height, told = self._told(setup, height)
        setup, unit, height = self._unit(setup, height)
        pixels = self._pixels(look, setup, now.error)
        return Checkup((*merged(findings), *unit), setup, pixels, given, height, told)

    def _agreement(self, look: Look, setup: Setup) -> Agreement:
        return agreement(look, setup, self.estimator, self.level, self.pairs)

    def _best(self, look: Look, setup: Setup, now: Agreement) -> tuple[Candidate, Agreement] | None:
        """The mistake whose undoing gains most, among those that pass."""
        tried = sorted(self._promising(look, setup, now), key=lambda pair: -pair[0])
        best = None
        most = 0.0
        for _, candidate in tried[:8]:
            after = self._agreement(look, candidate.setup)
            old, new = self._contrast(look, setup, candidate, now, after)
            gain = max(now.cost - after.cost, self._gain(candidate, old, new, len(setup)))
            gain *= (self.fitted if candidate.fitted else 1.0) ** (
                1 if candidate.views else 2
            )  # one lens before all
            if self._passes(candidate, old, new) and after.cost <= 1.02 * now.cost and gain > most:
                best = (candidate, after)
                most = gain
        return best

    def _contrast(
        self, look: Look, setup: Setup, candidate: Candidate, now: Agreement, after: Agreement
    ) -> tuple[float, float]:
        """Error of the views that a candidate is about before and after, over the quarter of their
        key points that it moves most: elsewhere a shift or a lens shows nothing but the detector's
        noise.
        """
        pairs = [
            self._of_moved(look, setup, candidate.setup, v, now, after)
            for v in candidate.views or range(len(setup))
        ]
        old, new = torch.tensor(pairs, dtype=torch.float64).mean(0).tolist()
        return old, new

    def _of_moved(
        self, look: Look, setup: Setup, other: Setup, view: int, now: Agreement, after: Agreement
    ) -> tuple[float, float]:
        old = look.view(setup, view)
        new = look.view(other, view)
        error = errors(old, setup.R[view], setup.t[view], now.points[view], now.known[view])
        tried = errors(new, other.R[view], other.t[view], after.points[view], after.known[view])
        distance = (new.xy - old.xy).norm(dim=-1) / old.size[:, None].clamp(min=1e-12)
        both = ~error.isnan() & ~tried.isnan()
        if int(both.sum()) < _FEW:  # nothing was triangulated before: there is no common ground
            return float(median(error)), float(median(tried))
        both &= distance >= distance[both].quantile(0.75)
        return float(median(torch.where(both, error, torch.nan))), float(
            median(torch.where(both, tried, torch.nan))
        )

    def _passes(self, candidate: Candidate, old: float, new: float) -> bool:
        return new <= self._ratio(candidate) * old and new <= old - self.least

    def _ratio(self, candidate: Candidate) -> float:
        if candidate.code == "out_of_sync":
            return self.shifted * (_ONE_FRAME if abs(candidate.value) == 1 else 1.0)
        if candidate.code in ("already_undistorted", "lens"):
            return (self.lens if candidate.views else self.lenses) * (
                _FITTED_LENS if candidate.fitted else 1.0
            )
        return self.fitted if candidate.fitted else self.discrete

    @staticmethod
    def _gain(candidate: Candidate, old: float, new: float, views: int) -> float:
        return 0.25 * (old - new) * (len(candidate.views) or views) / views

    def _promising(self, look: Look, setup: Setup, now: Agreement) -> list[tuple[float, Candidate]]:
        """(expected gain, candidate): those that pass against the people of now."""
        found = [*self._of_views(look, setup, now), *self._exchanges(look, setup, now)]
        return [*found, *self._of_file(look, setup)]

    def _of_file(self, look: Look, setup: Setup) -> list[tuple[float, Candidate]]:
        rays = look.all(setup)
        step = max(1, rays.xy.shape[1] // 12)
        pairs = all_pairs(len(setup), self.pairs)

        def cost(one: Setup) -> float:
            return float(
                pair_errors(look.all(one), one, pairs, step).clamp(max=LARGEST).mean(-1).amin()
            )

        as_is = cost(setup)
        found = [(as_is - cost(candidate.setup), candidate) for candidate in of_file(setup)]
        found.sort(key=lambda pair: -pair[0])
        undistorted = [pair for pair in found[3:] if pair[1].code == "already_undistorted"]
        return found[:3] + undistorted

    def _of_views(self, look: Look, setup: Setup, now: Agreement) -> list[tuple[float, Candidate]]:
        found = []
        for view in range(len(setup)):
            look.prepare(setup, view)
            tried = list(of_view(setup, view))
            tried += [shifted(setup, view, by) for by in self._shifts(look, setup, view)]
            tried += self._rates(look, setup, now, view)
            tried += self._moved(look, setup, now, view)
            each = []
            for candidate in tried:
                old, new = self._contrast(look, setup, candidate, now, now)
                if self._passes(candidate, old, new):
                    drop = float(now.error[view]) - self._against(look, candidate.setup, now, view)
                    gain = max(drop / len(setup), self._gain(candidate, old, new, len(setup)))
                    each.append((gain * (self.fitted if candidate.fitted else 1.0), candidate))
            each.sort(key=lambda pair: -pair[0])
            found += each[:2]
        return found

    def _shifts(self, look: Look, setup: Setup, view: int) -> list[int]:
        max_shift = look.evidence.max_shift
        return [
            by
            for by in range(-max_shift - setup.shift[view], max_shift - setup.shift[view] + 1)
            if by
        ]

    def _rates(self, look: Look, setup: Setup, now: Agreement, view: int) -> list[Candidate]:
        """Of a view that does not agree."""
        if look.evidence.at_rate is None or now.error[view] < self.rated or setup.rate[view] != 1:
            return []
        return [at_rate(setup, view, ratio) for ratio in RATES]

    def _moved(self, look: Look, setup: Setup, now: Agreement, view: int) -> list[Candidate]:
        found = resect(look.view(setup, view), now.points[view], now.known[view], LARGEST, 0)
        if found is None:
            return []
        R, t = found
        turn = float(rotation_deg(R, setup.R[view]))
        way = float((camera_centre(R, t) - camera_centre(setup.R[view], setup.t[view])).norm())
        text = (
            f"{{camera}} is not where the file has it: its key points fit a camera turned by {turn:.1f}° and "
            f"moved by {way:.0f} mm; calibrate it again"
        )
        return [Candidate("moved", (view,), text, setup.changed(view, R=R, t=t), turn, True)]

    def _exchanges(self, look: Look, setup: Setup, now: Agreement) -> list[tuple[float, Candidate]]:
        found = []
        for one, other in all_pairs(len(setup), 1 << 20).tolist():
            candidate = exchanged(setup, one, other)
            new = sum(self._against(look, candidate.setup, now, view) for view in (one, other))
            old = float(now.error[[one, other]].sum())
            if len(setup) <= 3 or self._passes(candidate, old / 2, new / 2):
                found.append(((old - new) / len(setup), candidate))
        found.sort(key=lambda pair: -pair[0])
        return found[:3]

    def _against(self, look: Look, setup: Setup, now: Agreement, view: int) -> float:
        rays = look.view(setup, view)
        return float(
            median(errors(rays, setup.R[view], setup.t[view], now.points[view], now.known[view]))
        )

    def _finding(
        self, look: Look, setup: Setup, candidate: Candidate, now: Agreement, after: Agreement
    ) -> Finding:
        names = [look.evidence.names[view] for view in candidate.views]
        about = list(candidate.views) or slice(None)
        before = float(self._pixels(look, setup, now.error)[about].mean())
        then = float(self._pixels(look, candidate.setup, after.error)[about].mean())
        text = candidate.text.format(
            camera=names[0] if names else "", other=names[-1] if names else ""
        )
        return Finding(candidate.code, tuple(names), text, candidate.value, before, then, True)

    def _left(self, look: Look, setup: Setup, now: Agreement) -> list[Finding]:
        """Views that nothing that was tried brings to the others."""
        names = look.evidence.names
        pixels = self._pixels(look, setup, now.error)
        off = now.error > self.astray
        if off.all():
            text = "no two views agree, and no mistake that is known explains it; calibrate again: python calibrate.py"
            return [
                Finding(
                    "nothing_agrees",
                    (),
                    text,
                    0.0,
                    float(pixels.mean()),
                    float(pixels.mean()),
                    False,
                )
            ]
        found = []
        for view in torch.nonzero(off)[:, 0].tolist():
            text = f"{names[view]} does not agree with the others, and no mistake that is known explains it"
            found.append(
                Finding(
                    "off",
                    (names[view],),
                    text,
                    float(now.error[view]),
                    float(pixels[view]),
                    float(pixels[view]),
                    False,
                )
            )
        return found

    def _stature(self, look: Look, setup: Setup, now: Agreement) -> float:
        """Of the person that all views together show (mm), as every command measures it; 0 where no
        views agree.
        """
        if not bool((now.error < self.level).any()):
            return 0.0
        points, known = triangulated(look.all(setup), setup, now.core[None], self.consensus)
        return float(stature(points[0], known[0]))

    @staticmethod
    def _told(setup: Setup, height: float) -> tuple[Setup, float, float | None]:
        """The setup and the person in mm, and the unit that the person tells where the file does
        not say it.
        """
        unit = unit_of(height / setup.unit_mm) if height and setup.unit_mm is not None else None
        if unit is None:
            return setup, height, None
        factor = unit / setup.unit_mm
        return replace(setup, t=factor * setup.t, unit_mm=None), factor * height, unit

    def _unit(self, setup: Setup, height: float) -> tuple[Setup, list[Finding], float]:
        low, high = STATURES
        if not height or low <= height <= high:
            return setup, [], height
        for factor, words in UNITS.items():
            if low <= factor * height <= high:
                text = (
                    f"the person measures {height:.3g} mm in the cameras' world: translations are {words}; "
                    f"multiply them by {factor:g}"
                )
                found = Finding("unit", (), text, factor, 0.0, 0.0, True)
                return replace(setup, t=factor * setup.t), [found], factor * height
        text = f"the person measures {height:.3g} mm in the cameras' world; check the length that gave the scale"
        return setup, [Finding("scale", (), text, height, 0.0, 0.0, False)], height

    def _pixels(self, look: Look, setup: Setup, error: Float[Tensor, " V"]) -> Float[Tensor, " V"]:
        size = look.all(setup).size
        typical = torch.where(size > 0, size, torch.nan).nanmedian(-1).values.nan_to_num(0.0)
        focal = (setup.K[:, 0, 0] * setup.K[:, 1, 1]).sqrt()
        return error * typical * focal


def merged(findings: list[Finding]) -> list[Finding]:
    """Of a camera that was put right in two steps of one kind the last word, from the first error."""
    result: list[Finding] = []
    for found in findings:
        same = [old for old in result if (old.code, old.cameras) == (found.code, found.cameras)]
        if same and found.code in ("out_of_sync", "moved", "lens"):
            result[result.index(same[0])] = replace(found, before_px=same[0].before_px)
        else:
            result.append(found)
    return result
