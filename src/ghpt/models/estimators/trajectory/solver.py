"""Rounds of reweighted least squares for the trajectory of one person."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.errors import check_positive
from ghpt.models.estimators.trajectory.groups import (
    BodyGroups,
    Bones,
    body_groups,
    spanning_bones,
)
from ghpt.models.estimators.trajectory.normal_matrix import (
    ConjugateGradients,
    NormalEquations,
    TimeCoupling,
    solve,
)
from ghpt.models.estimators.trajectory.priors import (
    BonePrior,
    MotionPrior,
    TimeAxis,
    bone_equations,
)
from ghpt.models.estimators.trajectory.rows import ReprojectionRows
from ghpt.models.estimators.trajectory.sides import OtherPeople, SideExchange
from ghpt.skeleton import Skeleton

_MEDIAN_LENGTH = 1.1774
"""Median length of a 2D vector whose coordinates are normal with deviation 1: sqrt(2 ln 2)."""
_COUNTS = 0.05
"""Weight from which a key point says that a joint is seen."""
_EARLIER = 20.0
"""By how much the tolerance of rounds before the last is larger."""
_SURE = 0.5
"""Robust weight from which a key point agrees with the estimate beyond doubt."""
_SURE_VIEWS = 3
"""So many of a joint's say where it is whatever bones say; two wrong ones may agree by chance."""
_SURE_DEVIATIONS = 3.0
"""Residual up to which a key point agrees with the start."""
_USUAL = 0.75
"""Quantile of a joint's accelerations that are expected where they are not seen."""
_START_DEVIATION = 10.0
"""Of the points that the solver starts from, mm, where they are first joined through time."""


@dataclass(frozen=True)
class Body:
    """What a recording says of its person and of the detector: the same in all of its frames."""

    scale: Float[Tensor, " J"]
    """Deviation of a key point's coordinate, mm at the body's depth."""
    length: Float[Tensor, " B"]
    """Of the bones, mm; 0 where unknown."""
    precision: Float[Tensor, " B"]
    """Of their lengths, mm^-2; 0 where unknown."""


@dataclass(frozen=True)
class Frames:
    """T successive frames of one person."""

    rows: ReprojectionRows
    weight: Float[Tensor, "V J T"]
    """What the detector's confidence makes of each key point."""
    start: Float[Tensor, "3 J T"]
    """Points of the local world to start from; 0 where not ``placed``."""
    placed: Bool[Tensor, "J T"]
    axis: TimeAxis


@dataclass(frozen=True)
class BoneTerms:
    """The bones of the last round."""

    ends: tuple[Int[Tensor, " B"], Int[Tensor, " B"]]
    direction: Float[Tensor, "3 B T"]
    precision: Float[Tensor, "B T"]
    """Of their lengths, mm^-2; 0 where a bone does not count."""


@dataclass(frozen=True)
class Solution:
    """The trajectory of one person."""

    points: Float[Tensor, "3 J T"]
    """Local world, mm."""
    body: Body
    precision: Float[Tensor, "V J T"]
    """Weight of each key point, mm^-2."""
    residual: Float[Tensor, "V J T"]
    """Length of each residual, mm."""
    used: Bool[Tensor, "V J T"]
    """The key points that there are, after sides have been exchanged."""
    order: Int[Tensor, "V J T"]
    """Which key point each joint has: another than its own where sides are exchanged."""
    observed: Float[Tensor, "6 J T"]
    """The normal matrices of the key points alone."""
    crossed: Bool[Tensor, "J T"]
    """Whether two rays or more say where the joint is."""
    time: TimeCoupling
    """What is known of the motion."""
    bones: BoneTerms


@dataclass(frozen=True)
class TrajectorySolver:
    """Robust reprojection, smooth motion and constant bones.

    ``noise``: a key point's deviation is this multiple of the one that the median residual of its
    joint says. A residual r weighs ``(1 + (r / (kernel x deviation))^2)^-2`` (Geman-McClure), with
    a kernel for each round: ``kernels`` without bones, then ``bone_kernels`` with them. The motion
    prior is adapted to the current estimate before every second round, and in the last one, when
    what is wrong has little weight left and may no longer pull, with ``last_factor``. ``exchange``
    and ``others``: what views may do beside seeing the joints of the person; null: nothing.
    ``group``: joints that are solved at once.
    """

    motion: MotionPrior
    bones: BonePrior
    exchange: SideExchange | None
    others: OtherPeople | None
    noise: float
    last_factor: float
    kernels: tuple[float, ...]
    bone_kernels: tuple[float, ...]
    group: int
    tolerance: float
    iterations: int

    def __post_init__(self) -> None:
        check_positive(noise=self.noise, group=self.group, tolerance=self.tolerance)
        check_positive(last_factor=self.last_factor)
        check_positive(iterations=self.iterations, rounds=len(self.kernels))

    def __call__(self, frames: Frames, skeleton: Skeleton, body: Body | None = None) -> Solution:
        """Return the trajectory of frames.

        Bones of the skeleton that close a circle are not used. ``body``: of the whole recording;
        None: these frames tell.
        """
        state = _Rounds(self, frames, skeleton, body)
        for number, kernel in enumerate(self.kernels):
            state.update(kernel, adapt=number in (2, 4), with_bones=False)
        state.measure_change()
        for number, kernel in enumerate(self.bone_kernels):
            if number in (0, 2):
                state.exchange_sides()
            last = number == len(self.bone_kernels) - 1
            state.tolerance = self.tolerance * (1 if last else _EARLIER)
            state.update(kernel, adapt=last or number % 2 == 0, with_bones=True, is_last=last)
        return state.solution()


class _Rounds:
    """The state of the rounds."""

    def __init__(
        self, solver: TrajectorySolver, frames: Frames, skeleton: Skeleton, body: Body | None
    ) -> None:
        self.solver = solver
        self.frames = frames
        self.skeleton = skeleton
        self.rows = frames.rows
        self.weight = frames.weight
        given = torch.arange(len(frames.placed))[:, None]
        self.order: Int[Tensor, "V J T"] = given.expand(frames.rows.used.shape)
        bones = skeleton.bones
        joints = len(frames.placed)
        kept = spanning_bones(joints, bones)
        self.bones: Bones = tuple(bones[index] for index in kept)
        self.single = body_groups(joints, (), 1)
        self.groups = body_groups(joints, self.bones, solver.group)
        self.ends = (
            torch.tensor([start for start, _ in self.bones], dtype=torch.int64),
            torch.tensor([end for _, end in self.bones], dtype=torch.int64),
        )
        start, end = self.ends
        self.both_placed = frames.placed[start] & frames.placed[end]
        self.near = solver.bones.near(self.both_placed, frames.axis)
        self.tolerance = solver.tolerance
        self.given = body
        self.deviation = solver.motion.initial(frames.start, self._sure_start(), frames.axis)
        self.seen = frames.rows.used.any(0)
        self.crossed = frames.placed
        self.sure = torch.zeros_like(frames.placed)
        self.change = torch.zeros_like(frames.start[0, :1])
        self.points = self._join_start()
        self.body = body or self._measure(self.points)

    def update(self, kernel: float, adapt: bool, with_bones: bool, is_last: bool = False) -> None:
        """Go one round."""
        solver = self.solver
        frames = self.frames
        residual = self.rows.residuals(self.points)
        if self.given is None:
            self.body = self._measure(self.points, residual)
        if adapt:
            motion = replace(solver.motion, factor=solver.last_factor) if is_last else solver.motion
            self.deviation = motion.adapt(self.points, frames.axis)
        scale = self.body.scale[:, None]
        relative = residual / scale
        robust = (1 + (relative / kernel).square()).square().reciprocal()
        if solver.others is not None:
            robust *= solver.others.weight(relative, self.rows.used, frames.axis)
        counted = self.weight * robust
        counts = (counted > _COUNTS) & self.rows.used
        self.seen = counts.any(0)
        self.crossed = counts.sum(0) >= 2
        self.sure = ((robust > _SURE) & self.rows.used).sum(0) >= _SURE_VIEWS
        self.precision = counted / scale.square()
        blocks, right = self.rows.sums(self.precision)
        self.observed = blocks.clone()
        weighted = blocks.new_zeros(3, 0, blocks.shape[-1])
        groups = self.single
        bones: Bones = ()
        if with_bones:
            groups = self.groups
            bones = self.bones
            terms = self._bone_terms()
            weighted = bone_equations(
                terms.direction, self.body.length, terms.precision, self.ends, blocks, right
            )
        equations = NormalEquations(blocks, right, self._coupling(), weighted)
        self.points = self._solve(equations, bones, groups)

    def exchange_sides(self) -> None:
        """Decide anew in which views left and right are exchanged."""
        exchange = self.solver.exchange
        if exchange is None:
            return
        frames = self.frames
        self.order = exchange.order(
            frames.rows, self.points, self.body.scale, self.skeleton, frames.axis
        )
        self.rows = frames.rows.exchange(self.order)
        self.weight = frames.weight.gather(1, self.order)

    def solution(self) -> Solution:
        return Solution(
            points=self.points,
            body=self.body,
            precision=self.precision,
            residual=self.rows.residuals(self.points),
            used=self.rows.used,
            order=self.order,
            observed=self.observed,
            crossed=self.crossed,
            time=self._known_motion(),
            bones=self._bone_terms(),
        )

    def _bone_terms(self) -> BoneTerms:
        direction, _ = self._directions(self.points)
        precision = self.body.precision[:, None]
        told = self.near * precision / (1 + precision * self.change)
        return BoneTerms(self.ends, direction, told)

    def measure_change(self) -> None:
        """Measure where views agree that a bone has another length than usual."""
        start, end = self.ends
        _, lengths = self._directions(self.points)
        body = self.body
        self.change = self.solver.bones.changes(
            lengths,
            self.sure[start] & self.sure[end],
            body.length,
            body.precision,
            self.frames.axis,
        )

    def _sure_start(self) -> Bool[Tensor, "J T"]:
        """Return which points of the start most of the joint's views agree with."""
        frames = self.frames
        residual = self.rows.residuals(frames.start)
        noise = joint_noise(residual, self.rows.used, self.weight, self.solver.noise)
        agrees = self.rows.used & (residual <= _SURE_DEVIATIONS * noise[:, None])
        enough = self.rows.used.sum(0).clamp(max=_SURE_VIEWS)
        return frames.placed & (agrees.sum(0) >= enough)

    def _join_start(self) -> Float[Tensor, "3 J T"]:
        """Return the start with what is missing in it carried over through time."""
        frames = self.frames
        precision = frames.placed / _START_DEVIATION**2
        none = torch.zeros_like(precision)
        blocks = torch.stack((precision, none, none, precision, none, precision))
        right = precision * frames.start
        bones = blocks.new_zeros(3, 0, blocks.shape[-1])
        equations = NormalEquations(blocks, right, self._coupling(), bones)
        return self._solve(equations, (), self.single)

    def _coupling(self) -> TimeCoupling:
        return self.solver.motion.coupling(self.deviation, self.seen, self.frames.axis)

    def _known_motion(self) -> TimeCoupling:
        """Return the coupling with the usual motion where no two rays cross.

        There the estimate is as smooth as the prior made it, and says nothing of the motion.
        """
        crossed = torch.where(self.crossed, self.deviation, torch.nan)
        usual = crossed.nanquantile(_USUAL, dim=-1, keepdim=True).nan_to_num(0.0)
        deviation = torch.where(self.crossed, self.deviation, torch.maximum(self.deviation, usual))
        return self.solver.motion.coupling(deviation, self.seen, self.frames.axis)

    def _solve(
        self, equations: NormalEquations, bones: Bones, groups: BodyGroups
    ) -> Float[Tensor, "3 J T"]:
        limit = ConjugateGradients(self.tolerance, self.solver.iterations)
        start = self.points if bones else equations.right
        return solve(equations, bones, groups, start, limit)

    def _directions(
        self, points: Float[Tensor, "3 J T"]
    ) -> tuple[Float[Tensor, "3 B T"], Float[Tensor, "B T"]]:
        """Return the directions and the lengths of the bones."""
        start, end = self.ends
        across = points[:, start] - points[:, end]
        x, y, z = across
        length = torch.addcmul(torch.addcmul(x * x, y, y), z, z).sqrt_()
        return across / length.clamp(min=1e-9), length

    def _measure(
        self, points: Float[Tensor, "3 J T"], residual: Float[Tensor, "V J T"] | None = None
    ) -> Body:
        """Return what the current estimate says of the body."""
        if residual is None:
            residual = self.rows.residuals(points)
        _, lengths = self._directions(points)
        length, precision = self.solver.bones.measure(lengths, self.both_placed)
        noise = joint_noise(residual, self.rows.used, self.weight, self.solver.noise)
        return Body(noise, length, precision)


_LEAST_NOISE = 1.0
"""mm. No detector is better; key points without any error would leave time and bones no say."""


def joint_noise(
    residual: Float[Tensor, "V J T"],
    used: Bool[Tensor, "V J T"],
    weight: Float[Tensor, "V J T"],
    factor: float,
) -> Float[Tensor, " J"]:
    """Return the deviation of each joint's key points, mm: so many times what the median says.

    It is told by the median that the weights make: what a detector guesses, with little confidence,
    says nothing of the others. That of a joint that nobody sees is the median joint's.
    """
    measured = used & residual.isfinite()
    median = _weighted_median(
        torch.where(measured, residual, torch.inf).transpose(0, 1).flatten(1),
        torch.where(measured, weight, 0.0).transpose(0, 1).flatten(1),
    )
    typical = median.nanmedian()
    median = torch.where(median.isnan(), typical, median).nan_to_num(1.0)
    return factor * (median / _MEDIAN_LENGTH).clamp(min=_LEAST_NOISE)


def _weighted_median(
    values: Float[Tensor, "J N"], weights: Float[Tensor, "J N"]
) -> Float[Tensor, " J"]:
    """Return the least value up to which lies half of the weight; NaN where there is none."""
    ordered, order = values.sort(dim=-1)
    below = weights.gather(-1, order).cumsum(-1)
    total = below[:, -1:]
    at = (below < total / 2).sum(-1, keepdim=True)
    median = ordered.gather(-1, at)
    return torch.where(total > 0, median, torch.nan)[:, 0]
