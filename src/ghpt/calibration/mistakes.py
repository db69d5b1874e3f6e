"""The catalogue of mistakes: what each is called, what is said of it, and how it is undone.

`calibrate.py`, `cameras.py` and `predict.py` all take their findings from here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from ghpt.calibration.check.setup import Setup
from ghpt.calibration.findings import Finding, Severity
from ghpt.geometry.cameras import camera_centre
from ghpt.models.relative_pose.scale import HUMAN, STATURES

UNITS = {
    1e3: "metres for millimetres",
    1e2: "decimetres for millimetres",
    1e1: "centimetres for millimetres",
    1e-1: "ten times too large",
    1e-2: "a hundred times too large",
    1e-3: "millimetres for metres",
}
"""What each factor says of a length that it must be multiplied by."""
RESOLUTIONS = (0.25, 1 / 3, 0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0, 3.0, 4.0)
"""Ratios of the resolutions that cameras and encoders offer."""
RADIAL = tuple(k / 20 for k in range(-9, 10) if k)
"""The k1 of the lenses that are tried."""
_FPS = (24.0, 25.0, 30.0, 50.0, 60.0, 100.0, 120.0)
RATES = tuple(sorted({a / b for a in _FPS for b in _FPS if a != b and 0.2 < a / b < 5}))
"""Ratios of the frame rates that cameras offer."""
_ALL = "all cameras"

Undo = Callable[[Setup, tuple[int, ...], float], Setup]
"""Returns the setup with a mistake of some views, and of a value, undone."""
PoseUndo = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class Mistake:
    """One kind of mistake.

    ``message`` and ``hint`` are templates of the names and numbers that `finding` is given.
    """

    code: str
    message: str
    """What is wrong."""
    hint: str
    """What to do."""
    severity: Severity = Severity.ERROR
    undo: Undo | None = None
    """None for what cannot be undone, or only where more is known than a setup."""
    values: tuple[float, ...] = (0.0,)
    """The values that are tried, such as ratios; 0 for a mistake that has none."""
    needs_extrinsics: bool = True
    """Whether it can be seen only in cameras whose extrinsics are given."""
    of_one: bool = True
    """Whether it is tried of one camera alone."""
    of_all: bool = True
    """Whether it is tried of all cameras alike."""
    fitted: bool = False
    """Whether undoing it fits a number to the key points, rather than choosing one of a few."""

    def describe(
        self, cameras: tuple[str, ...] = (), value: int | float = 0.0, **words: object
    ) -> str:
        """Return the sentence on these cameras, without its full stop."""
        names = {
            "camera": cameras[0] if cameras else _ALL,
            "other": cameras[-1] if cameras else _ALL,
            "cameras": ", ".join(cameras) or _ALL,
            "value": value,
            "frames": abs(value),
            "direction": "late" if value > 0 else "early",
            "unit": UNITS.get(value, ""),
        }
        return f"{self.message}; {self.hint}".format(**(names | words))

    def finding(
        self,
        cameras: tuple[str, ...] = (),
        value: int | float = 0.0,
        limit: int | float = 0.0,
        severity: Severity | None = None,
        **words: object,
    ) -> Finding:
        """Return the finding of this mistake; ``words`` fill the other places of the templates."""
        text = self.describe(cameras, value, limit=limit, **words)
        return Finding(self.code, severity or self.severity, text, cameras, value, limit)


@dataclass(frozen=True)
class Candidate:
    """A setup in which one mistake is undone."""

    mistake: Mistake
    views: tuple[int, ...]
    """The views whose mistake it is; empty where it is that of all."""
    setup: Setup
    value: int | float
    """The mistake's own number: frames, a ratio, k1, degrees; 0 where it has none."""


def of_all_views(setup: Setup) -> Iterator[Candidate]:
    """Yield the mistakes that all cameras may share, each undone."""
    every = tuple(range(len(setup)))
    for mistake in MISTAKES:
        if mistake.of_all and mistake.undo is not None:
            for value in mistake.values:
                if mistake is ALREADY_UNDISTORTED and not setup.lens.any():
                    continue
                yield Candidate(mistake, (), mistake.undo(setup, every, value), value)


def of_one_view(setup: Setup, view: int) -> Iterator[Candidate]:
    """Yield the mistakes of one camera that its setup alone tells how to undo, each undone."""
    for mistake in MISTAKES:
        if mistake.of_one and mistake.undo is not None:
            for value in mistake.values:
                if mistake is ALREADY_UNDISTORTED and not setup.lens[view].any():
                    continue
                yield Candidate(mistake, (view,), mistake.undo(setup, (view,), value), value)


def without_extrinsics(setup: Setup, view: int) -> Iterator[Candidate]:
    """Yield those of them that show in a camera whose extrinsics are not known."""
    for candidate in of_one_view(setup, view):
        if not candidate.mistake.needs_extrinsics:
            yield candidate


def shift_view(setup: Setup, view: int, by: int) -> Candidate:
    """Return the setup in which a view is taken ``by`` frames later than now."""
    total = setup.shift[view] + by
    return Candidate(OUT_OF_SYNC, (view,), setup.replace_camera(view, shift=total), float(total))


def at_rate(setup: Setup, view: int, ratio: float) -> Candidate:
    """Return the setup in which a view has ``ratio`` times the frame rate of the others."""
    return Candidate(FRAME_RATE, (view,), setup.replace_camera(view, rate=ratio), ratio)


def exchange_views(setup: Setup, one: int, other: int) -> Candidate:
    """Return the setup in which two cameras have each other's key points."""
    new = setup
    for view, source in ((one, other), (other, one)):
        new = new.replace_camera(
            view,
            source=setup.source[source],
            shift=setup.shift[source],
            sides=setup.sides[source],
            rate=setup.rate[source],
        )
    return Candidate(VIEWS_SWAPPED, (one, other), new, 0.0)


def size_finding(height: float) -> Finding | None:
    """Return what is wrong with a person of this height (mm); None for a person of human size.

    A unit of length is to blame if it makes the person human, else the scale.
    """
    low, high = STATURES
    if low <= height <= high:
        return None
    human = HUMAN[0] <= height <= HUMAN[1]
    severity = Severity.WARNING if human else Severity.ERROR
    sizes = {"metres": height / 1000, "low": low / 1000, "high": high / 1000}
    for factor in UNITS:
        if low <= factor * height <= high:
            return UNIT.finding((), factor, 0.0, severity, **sizes)
    limit = low if height < low else high
    return SCALE.finding((), height, limit, severity, **sizes)


def _undo_poses(change: PoseUndo) -> Undo:
    def undo(setup: Setup, views: tuple[int, ...], value: int | float) -> Setup:
        at = list(views)
        R = setup.R.clone()
        t = setup.t.clone()
        R[at], t[at] = change(setup.R[at], setup.t[at])
        return replace(setup, R=R, t=t)

    return undo


def transpose(R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Return the pose with its rotation transposed."""
    return R.mT, t


def translation_of_centre(R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Return the pose whose centre is ``t``."""
    return R, -(R @ t[..., None])[..., 0]


def invert(R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Return the inverse of the pose."""
    return R.mT, camera_centre(R, t)


def flip_axes(R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Return the pose with the camera's y and z axes reversed."""
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=R.dtype))
    return flip @ R, t @ flip


def invert_and_flip_axes(R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Return the inverse of the pose with the camera's y and z axes reversed."""
    return flip_axes(*invert(R, t))


def _scale_translation(setup: Setup, views: tuple[int, ...], value: int | float) -> Setup:
    t = setup.t.clone()
    t[list(views)] *= value
    return replace(setup, t=t)


def _scale_intrinsics(setup: Setup, views: tuple[int, ...], value: int | float) -> Setup:
    K = setup.K.clone()
    K[list(views), :2] *= value
    return replace(setup, K=K)


def _set_lens(setup: Setup, views: tuple[int, ...], value: int | float) -> Setup:
    lens = setup.lens.clone()
    radial = radial_lens(value)
    lens[list(views)] = torch.nn.functional.pad(radial, (0, lens.shape[-1] - len(radial)))
    return replace(setup, lens=lens)


def radial_lens(k1: float) -> Float[Tensor, " 5"]:
    """Return the distortion of a lens with one radial coefficient."""
    return torch.tensor([k1, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)


def _toggle(values: tuple[bool, ...], views: tuple[int, ...]) -> tuple[bool, ...]:
    return tuple(value != (view in views) for view, value in enumerate(values))


def _exchange_sides(setup: Setup, views: tuple[int, ...], value: int | float) -> Setup:
    return replace(setup, sides=_toggle(setup.sides, views))


def _mirror(setup: Setup, views: tuple[int, ...], value: int | float) -> Setup:
    return replace(setup, mirrored=_toggle(setup.mirrored, views))


def _turn(setup: Setup, views: tuple[int, ...], value: int | float) -> Setup:
    return setup.turn_images(views, round(value))


def _mirror_and_exchange_sides(setup: Setup, views: tuple[int, ...], value: int | float) -> Setup:
    return _mirror(_exchange_sides(setup, views, value), views, value)


ALREADY_UNDISTORTED = Mistake(
    "already_undistorted",
    "key points of {camera} are undistorted already",
    "give no distortion with them",
    undo=_set_lens,
)
LENS = Mistake(
    "lens",
    "the lens of {camera} does not fit: k1 = {value:g} fits better",
    "calibrate the intrinsics",
    undo=_set_lens,
    values=RADIAL,
    fitted=True,
)
IMAGE_TURNED = Mistake(
    "image_turned",
    "key points of {camera} are of images turned by {value:g} degrees (clockwise) against the "
    "calibration's",
    "give the cameras of the turned images, which the camera check writes, or detect again in "
    "images that are turned back",
    undo=_turn,
    values=(90, 180, 270),
    needs_extrinsics=False,
)
UNIT_OF_ONE = Mistake(
    "unit",
    "t of {camera} is in another unit than the others' ({unit})",
    "multiply it by {value:g}",
    undo=_scale_translation,
    values=tuple(UNITS),
    of_all=False,
)
MISTAKES = (
    Mistake(
        "rotation_transposed",
        "R of {camera} is camera to world where world to camera is wanted",
        "transpose R",
        undo=_undo_poses(transpose),
    ),
    Mistake(
        "centre_for_translation",
        "t of {camera} is the camera's centre C",
        "give t = -R C",
        undo=_undo_poses(translation_of_centre),
    ),
    Mistake(
        "camera_to_world",
        "R and t of {camera} are camera to world",
        "invert them: R^T and -R^T t",
        undo=_undo_poses(invert),
    ),
    Mistake(
        "axes_flipped",
        "the axes of {camera} are y up, z backward (OpenGL)",
        "turn them: y down, z forward",
        undo=_undo_poses(flip_axes),
    ),
    Mistake(
        "camera_to_world_flipped",
        "R and t of {camera} are camera to world with y up and z backward (OpenGL, Blender)",
        "invert them, then turn y and z",
        undo=_undo_poses(invert_and_flip_axes),
    ),
    UNIT_OF_ONE,
    Mistake(
        "resolution",
        "intrinsics of {camera} fit the key points when scaled by {value:.3g}",
        "give both at one resolution",
        undo=_scale_intrinsics,
        values=RESOLUTIONS,
        needs_extrinsics=False,
    ),
    IMAGE_TURNED,
    ALREADY_UNDISTORTED,
    LENS,
    Mistake(
        "sides_swapped",
        "left and right joints of {camera} are exchanged",
        "exchange them back",
        undo=_exchange_sides,
        needs_extrinsics=False,
        of_all=False,
    ),
    Mistake(
        "mirrored_key_points",
        "key points of {camera} are those of a mirrored image",
        "turn its mirroring off, or give u as width - 1 - u",
        undo=_mirror,
        needs_extrinsics=False,
    ),
    Mistake(
        "mirrored_image",
        "the image of {camera} is mirrored",
        "turn its mirroring off, or give u as width - 1 - u with left and right joints exchanged",
        undo=_mirror_and_exchange_sides,
        needs_extrinsics=False,
    ),
)
"""The mistakes that a setup alone tells how to undo, in the order in which they are tried."""

VIEWS_SWAPPED = Mistake(
    "views_swapped",
    "key points of {camera} are those of {other}, and the reverse",
    "exchange the two names",
)
OUT_OF_SYNC = Mistake(
    "out_of_sync",
    "{camera} is {frames:g} frames {direction}: its frame n{value:+g} goes with frame n of the "
    "others",
    "shift its frames",
)
FRAME_RATE = Mistake(
    "frame_rate",
    "{camera} has another frame rate: {value:.3g} of its frames go with one of the others'",
    "take those of the others' moments (frame numbers must be of one clock)",
)
TIME_UNKNOWN = Mistake(
    "time_unknown",
    "when the frames of {cameras} were taken cannot be told from the people in view",
    "let somebody walk and turn before all cameras, or clap",
    Severity.WARNING,
)
FOCAL_UNKNOWN = Mistake(
    "focal_unknown",
    "the focal length is not determined by the people in view ({why})",
    "give it (cameras=intrinsics.toml), or let somebody walk and turn before three cameras or more",
)
FOCAL_DIFFERS = Mistake(
    "focal_differs",
    "{cameras} have another focal length than the others, by {value:.1f} standard deviations",
    "estimate one for each: intrinsics.focal=each",
    Severity.WARNING,
)
MOVED = Mistake(
    "moved",
    "{camera} is not where the file has it: its key points lie as if it were rotated by "
    "{value:.1f}°",
    "calibrate it again",
    fitted=True,
)
MOVED_ONE_OF = Mistake(
    "moved",
    "one of {cameras} is not where the file has it, and the people in view do not tell which: key "
    "points of {camera} lie as if it were rotated by {value:.1f}°, and moving another explains "
    "them as well",
    "calibrate the rig again, or let somebody walk and turn before it",
)
OFF = Mistake(
    "off",
    "{camera} does not agree with the others, and no mistake that is known explains it",
    "calibrate it again, or leave it out",
)
NOTHING_AGREES = Mistake(
    "nothing_agrees",
    "no two views agree, and no mistake that is known explains it",
    "calibrate the rig again",
)
UNIT = Mistake(
    "unit",
    "the person measures {metres:,.3g} m, and people measure {low:g} to {high:g} m: lengths of "
    "{camera} are {unit}",
    "multiply them by {value:g}",
)
SCALE = Mistake(
    "scale",
    "the person measures {metres:,.3g} m, and people measure {low:g} to {high:g} m",
    "check the length that gave the scale and its unit (millimetres)",
)
SEVERAL_PEOPLE = Mistake(
    "several_people",
    "several people in {frames_of_views}",
    "the one tracked best in each view was followed, and must be the same person in all",
    Severity.WARNING,
)
SCALE_UNKNOWN = Mistake(
    "scale_unknown", "Scale {source}", "give scale.height, scale.segments or scale.baseline"
)
SCALE_ASSUMED = Mistake(
    "scale_assumed",
    "Scale {source}",
    "give scale.height, scale.segments or scale.baseline",
    Severity.WARNING,
)
FEW_FRAMES = Mistake(
    "few_frames",
    "{value:.0f} usable frame{plural}, {limit:.0f} or more are needed for a rig to rely on",
    "record longer, with a person that several cameras see at a time",
    Severity.WARNING,
)
LITTLE_MOTION = Mistake(
    "little_motion",
    "{used} frames are worth {independent:.0f} independent ones, and people turn by {turned:.0f} "
    "degrees: rotations are known to ± {value:.1f} degrees",
    "let somebody walk through the whole volume and turn for 20 s, which gives ± 0.5 or so: "
    "{needed}",
    Severity.WARNING,
)
OUTSIDE_IMAGE = Mistake(
    "resolution",
    "key points of {camera} reach {extent}, {value:.0%} are outside",
    "give intrinsics and key points of one and the same resolution",
)
UNUSED_IMAGE = Mistake(
    "resolution",
    "key points of {camera} reach no further than {extent}",
    "give intrinsics and key points of one and the same resolution",
    Severity.WARNING,
)
NOTHING_LINKED = Mistake(
    "unlinked",
    "no two cameras can be linked: at best {common} common key points, {value:.0f} of which agree "
    "with one relative pose",
    "check that the cameras are apart, synchronised, and see the same moving person",
)
UNLINKED = Mistake(
    "unlinked",
    "{camera} cannot be linked to the other cameras: at best {common} common key points with one "
    "of them, {value:.0f} of which agree",
    "check its intrinsics, its synchronisation, and that it sees the same person",
)
DISAGREEMENT = Mistake(
    "disagreement",
    "{value:.0%} of {camera}'s key points agree with the other cameras, and those are off by "
    "{off:.1%} of the person's size (median of the cameras: {usual:.1%})",
    "check its intrinsics, its synchronisation and its key points",
    Severity.WARNING,
)
LARGE_RESIDUALS = Mistake(
    "large_residuals",
    "key points of {camera} are off by {value:.1%} of the person's size ({pixels:.1f} px), "
    "detectors' by 1 to 2 %",
    "check all intrinsics, lens distortion and synchronisation",
    Severity.WARNING,
)
SAME_PLACE = Mistake(
    "same_place",
    "{camera} and {other} are {value:.1%} of the rig's size apart",
    "check that they are not one camera given twice",
)
TWO_VIEWS = Mistake(
    "two_views",
    "two cameras only, whose rays meet at {value:.0f} degrees: nothing checks them, and depths "
    "are weak where the angle is near 0 (side by side, or opposite)",
    "add a third camera",
    Severity.WARNING,
)
FLAT = Mistake(
    "flat",
    "all points lie near {shape} (thickness {value:.1%} of the length), which leaves several rigs "
    "possible",
    "let the person move in depth and turn",
    Severity.WARNING,
)
PROPORTIONS = Mistake(
    "proportions",
    "the person's bones are out of human proportion by a factor {value:.2f}",
    "check the joints' order and the intrinsics, and do not scale this rig by a body",
    Severity.WARNING,
)
NOT_CONVERGED = Mistake(
    "not_converged",
    "the bundle adjustment stopped after {iterations} steps short of a minimum",
    "raise bundle.iterations and bundle.seconds, or look at the other findings",
)
ILL_CONDITIONED = Mistake(
    "ill_conditioned",
    "the recording hardly determines {cameras}: standard deviation up to {degrees:.2g} degrees "
    "and {value:.1%} of the rig's size",
    "record more motion through the whole volume, or place cameras so that they look across one "
    "another",
    Severity.WARNING,
)
LEFT_OUT_ERROR = Mistake(
    "left_out_error",
    "{whose} key points lie {value:.1%} of the person's size from the joints",
    "check the cameras",
)
FEW_VIEWS_AGREE = Mistake(
    "few_views_agree", "{agree} of {views} views agree with the others", "check the cameras"
)
LITTLE_OBSERVED = Mistake(
    "little_observed",
    "{value:.1%} of the joints are observed, from the first frame with one to the last",
    "the report says which joints; take key points that are more complete",
)
REJECTED = Mistake(
    "rejected",
    "no two views explain {value:.1%} of the joints, which were rejected",
    "check the cameras",
)
