"""The last frames of a person's trajectory, which are solved together whenever a new one comes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from ghpt.geometry.cameras import Cameras
from ghpt.models.estimators.confidence import LEAST_CONFIDENCE
from ghpt.models.estimators.trajectory.estimator import Trajectory
from ghpt.models.estimators.trajectory.fixed_lag import Factored, Group, Prior, WindowTerms
from ghpt.models.estimators.trajectory.groups import Bones, body_groups, spanning_bones
from ghpt.models.estimators.trajectory.priors import NOMINAL_RATE, MotionPrior
from ghpt.models.estimators.trajectory.running import RunningBody, Sample
from ghpt.models.estimators.trajectory.sides import sided_limbs
from ghpt.models.estimators.trajectory.sightings import Frame, Rig, Stack, residual_lengths
from ghpt.models.estimators.trajectory.windows import Clock

Array = np.ndarray

_COUNTS = 0.05
"""Weight from which a key point says that a joint is seen."""
_TINY = 1e-5
"""Of the velocity prior's precision: keeps the matrix of what nobody sees positive definite."""
_REACH = 3.0
"""Deviations that a Gaussian average reaches."""
_SINGULAR = 1e-9
"""Of the trace of a normal matrix: what makes that of parallel rays solvable."""
_LOST = 1.5
"""Views more that fit a frame's own points than fit the trajectory: then it has lost them."""
_LEAST_LOST = 3
"""Frames that tell this."""
_UPPER = ((0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2))
"""Rows and columns of the elements xx xy xz yy yz zz."""


@dataclass(frozen=True)
class WindowSettings:
    """The terms of a window.

    ``trajectory`` gives the terms and their settings, but for the ``motion``. Of its rounds without
    bones the start goes all, of those with bones each frame goes the last. ``joints``: so many are
    solved at once; bones between two such groups do not count. ``pairs``: so many pairs of views
    are tried for a joint of a new frame.
    """

    trajectory: Trajectory
    motion: MotionPrior
    joints: int
    pairs: int


@dataclass(frozen=True)
class Alone:
    """What K frames say on their own, without time and bones."""

    points: Float[Array, "K J 3"]
    """The best of the points of pairs of views."""
    placed: Bool[Array, "K J"]
    """Whether two views agree on one."""
    merit: Float[Array, "K J"]
    """How many views fit the best one, each with a weight from 0 to 1."""

    def join(self, other: Alone) -> Alone:
        """Return the frames of both."""
        return Alone(
            np.concatenate((self.points, other.points)),
            np.concatenate((self.placed, other.placed)),
            np.concatenate((self.merit, other.merit)),
        )

    def without_oldest(self) -> Alone:
        return Alone(self.points[1:], self.placed[1:], self.merit[1:])


class LagWindow:
    """K frames, oldest first, in the world of `Rig`; lengths are those of an adult.

    ``origin`` (mm) and ``size`` say where it is in the cameras' world. It begins with ``points`` of
    the ``frames``, which are right where they are ``placed``.
    """

    given: Stack
    """The key points as the detector gives them."""
    current: Stack
    """The same with left and right put right."""
    seen: Bool[Array, "K J"]
    """Whether any view counts."""
    median: Float[Array, "K V"]
    """Of the residuals of each view, in their deviations."""
    gain: Float[Array, "K V L"]
    """Of an exchange of left and right, for each view and limb."""

    def __init__(
        self,
        settings: WindowSettings,
        clock: Clock,
        frames: list[Frame],
        points: Float[Array, "K J 3"],
        placed: Bool[Array, "K J"],
        origin: torch.Tensor,
        size: float,
    ) -> None:
        trajectory = settings.trajectory
        skeleton = trajectory.skeleton
        views, joints = frames[0].used.shape
        self.settings = settings
        self.solver = trajectory.solver
        self.clock = clock
        self.unit = (NOMINAL_RATE / clock.rate_hz) ** 2  # of accelerations, mm/frame^2
        self.origin = origin
        self.size = size
        bones = skeleton.bones
        self.bones: Bones = tuple(bones[index] for index in spanning_bones(joints, bones))
        self.ends = np.array(self.bones, dtype=np.int64).reshape(-1, 2).T
        self.groups = _groups(joints, self.bones, settings.joints)
        self.mirror = np.array(skeleton.mirror)
        self.limbs = sided_limbs(skeleton) if self.solver.exchange else ()
        self.rigs: list[Rig] = []
        self.frames: list[Frame] = []
        for frame in frames:
            rig = self._rig(frame)
            self._append(frame, rig, Stack.of(frame, rig))
        self.points = _interpolate((points - origin.numpy()) / size, placed)
        merit = np.zeros(placed.shape)
        self.alone = Alone(self.points, placed, merit)
        """What the frames say on their own."""
        self.as_given = np.arange(joints)
        self.order: Int[Array, "K V J"] = np.broadcast_to(self.as_given, self.given.used.shape)
        self.seen = np.asarray(self.given.used.any(1))
        self.residual = self.given.residuals(self.points)
        """[K V J]: the lengths of the residuals, mm at the body's depth."""
        self.squares = np.zeros((0, joints))
        """Mean squares of the second differences around the inner frames that are solved."""
        self.total: Float[Array, "K J 4 4"] = self.given.gram.sum(1)
        """The normal equations of the key points alone."""
        self.groups_terms: list[WindowTerms] = []
        self.factored: list[Factored] = []
        self.prior: list[Prior | None] = [None] * len(self.groups)
        self.past_square = np.zeros((0, joints))
        self.past_median = np.zeros((0, views))
        self.past_gain = np.zeros((0, views, len(self.limbs)))
        self.placed_at = np.full(len(self.bones), -np.inf)
        """Number of the last frame left behind that places both ends of a bone."""

    def __len__(self) -> int:
        return len(self.frames)

    def start(self, body: RunningBody) -> None:
        """Go all rounds without bones."""
        for kernel in self.solver.kernels:
            self._round(body, kernel, with_bones=False)

    def refine(self, body: RunningBody) -> None:
        """Go one round."""
        self._round(body, self.solver.bone_kernels[-1], with_bones=True)

    def push(self, frame: Frame, body: RunningBody) -> None:
        """Take the next frame."""
        rig = self._rig(frame)
        new = Stack.of(frame, rig)
        points, alone = self._place(new, rig, body)
        self._append(frame, rig, new)
        self.points = np.concatenate((self.points, points[None]))
        self.alone = self.alone.join(alone)
        self.refine(body)
        self._recover(body)

    def drop(self) -> None:
        """Leave the oldest frame behind; what it says of the next two goes into the prior."""
        for number, group in enumerate(self.groups):
            self.prior[number] = group.marginal(self.groups_terms[number], self.prior[number])
            found = self.factored[number]
            self.factored[number] = replace(found, points=found.points[1:])
        motion = self.settings.motion
        self.past_square = self._keep(self.past_square, self.squares, motion.window_s)
        if self.solver.others is not None:
            window_s = self.solver.others.window_s
            self.past_median = self._keep(self.past_median, self.median, window_s)
        if self.solver.exchange is not None and self.limbs:
            window_s = self.solver.exchange.window_s
            self.past_gain = self._keep(self.past_gain, self.gain, window_s)
        number = self.frames[0].number
        self.placed_at = np.where(np.asarray(self._placed_bones)[0], number, self.placed_at)
        del self.frames[0]
        del self.rigs[0]
        self.given = self.given.without_oldest()
        self.current = self.current.without_oldest()
        self.points = self.points[1:]
        self.alone = self.alone.without_oldest()
        self.order = self.order[1:]
        self.seen = self.seen[1:]
        self.total = self.total[1:]
        self.residual = self.residual[1:]
        self.squares = self.squares[1:]

    def _recover(self, body: RunningBody) -> None:
        """Begin anew with the joints that have lost their key points.

        In all frames of the window their views agree on other points, and more of them do.
        """
        limit = self.settings.trajectory.agree * body.scale
        merit = (self.current.used / (1 + (self.residual / limit) ** 2)).sum(1)
        fit = merit.sum(0) / len(self)
        alone = self.alone.merit.sum(0) / len(self)
        # the points of two views fit them whatever they are
        told = (alone > 2) | (fit < 1)
        lost = (alone - fit > _LOST) & told
        if not lost.any() or len(self) < _LEAST_LOST:
            return
        self.points[:, lost] = self.alone.points[:, lost]
        for number, group in enumerate(self.groups):
            prior = self.prior[number]
            chosen = lost[group.joints]
            if prior is not None and chosen.any():
                self.prior[number] = prior.forget(chosen)
        self.refine(body)

    def depth(self, place: int) -> Float[Array, "V J"]:
        """Return the depth of a frame's joints in each view, mm."""
        return self.rigs[place].depth(self.points[place])

    def world(self, place: int) -> Float[Array, "J 3"]:
        """Return the points of a frame in the world of the cameras, mm."""
        return self.size * self.points[place] + self.origin.numpy()

    def covariance(self, place: int) -> Float[Array, "J 6"]:
        """Return the covariances xx xy xz yy yz zz of a frame, mm^2 in the cameras' world."""
        found = np.empty((len(self.as_given), 6))
        for factored, group in zip(self.factored, self.groups, strict=True):
            matrix = factored.covariance(place)
            found[group.joints] = self.size**2 * matrix[:, _UPPER[0], _UPPER[1]]
        return found

    def sample(self, place: int, residual: Float[Array, "V J"]) -> Sample:
        """Return what a frame, which has these residuals, tells of the person."""
        lengths = _lengths(self._across(self.points[place]))
        free = _lengths(self._across(self._alone(place)))
        extent = (
            self.frames[place].extent
            * self.depth(place).sum(1)
            / len(self.as_given)
            / self.rigs[place].focal
        )
        known = np.sort(extent[np.isfinite(extent) & (extent > 0)])
        return Sample(
            residual=residual,
            used=self.current.used[place],
            confidence=self.current.confidence[place],
            lengths=lengths,
            free_lengths=free,
            placed=self._placed_bones[place],
            extent=float(known[len(known) // 2]) if len(known) else np.nan,
        )

    def _alone(self, place: int) -> Float[Array, "J 3"]:
        """Return the points of a frame by its key points alone, with the weights that they have."""
        total = self.total[place]
        matrix = total[:, :3, :3]
        ridge = _SINGULAR * np.trace(matrix, axis1=-2, axis2=-1) + 1e-300
        points: Array = np.linalg.solve(
            matrix + ridge[:, None, None] * np.eye(3), -total[:, :3, 3:]
        )[..., 0]
        return points

    def _rig(self, frame: Frame) -> Rig:
        if self.frames and _are_equal(frame.cameras, self.frames[-1].cameras):
            return self.rigs[-1]
        return Rig.of(frame.cameras, self.origin, self.size)

    def _append(self, frame: Frame, rig: Rig, new: Stack) -> None:
        self.given = self.given.join(new) if self.frames else new
        self.current = self.given
        self.frames.append(frame)
        self.rigs.append(rig)

    def _round(self, body: RunningBody, kernel: float, with_bones: bool) -> None:
        residual = self._exchange_sides(body)
        stack = self.current
        relative = residual / body.scale
        counted = (1 + (relative / kernel) ** 2) ** -2 * stack.used
        if self.solver.others is not None:
            self.median = _median(relative, stack.used)
            window_s = self.solver.others.window_s
            smooth = self._smooth(self.past_median, self.median, window_s)
            counted *= self.solver.others.view_weight(smooth)[..., None]
        if body.exponent:
            counted *= np.maximum(stack.confidence, LEAST_CONFIDENCE) ** body.exponent
        self.seen = counted.max(1) > _COUNTS
        precision = counted / body.scale**2
        total = (precision[..., None, None] * stack.gram).sum(1)
        self.total = total
        weak = 1 / (self.settings.motion.speed**2 * self.unit)
        unseen = ~(self.seen[1:] & self.seen[:-1])
        first = weak * (unseen + _TINY)
        second = self._accelerations()
        across = self._across(self.points)
        root = np.sqrt(body.precision * self._near() * with_bones)
        directions = across * (root / np.maximum(_lengths(across), 1e-9))[..., None]
        pull = np.broadcast_to(root * body.length, directions.shape[:-1])
        points = np.empty_like(self.points)
        self.groups_terms = []
        self.factored = []
        for group, prior in zip(self.groups, self.prior, strict=True):
            chosen = total[:, group.joints]
            terms = WindowTerms(
                blocks=chosen[..., :3, :3],
                right=-chosen[..., :3, 3],
                first=first[:, group.joints],
                second=second[:, group.joints],
                least=_TINY * weak,
                directions=directions[:, group.bones],
                pull=pull[:, group.bones],
            )
            found = group.solve(terms, prior)
            points[:, group.joints] = found.points
            self.groups_terms.append(terms)
            self.factored.append(found)
        self.points = points
        self.residual = self.current.residuals(points)
        self.squares = self._squares()

    def _exchange_sides(self, body: RunningBody) -> Float[Array, "K V J"]:
        """Decide anew in which views left and right are exchanged; return the residuals."""
        exchange = self.solver.exchange
        given = self.given
        residual = given.residuals(self.points)
        self.current = given
        self.order = np.broadcast_to(self.as_given, given.used.shape)
        if exchange is None or not self.limbs:
            return residual
        other = residual_lengths(given.rows[..., self.mirror], self.points)
        both = given.used & given.used[..., self.mirror]
        loss = np.log1p((residual / body.scale) ** 2) - np.log1p((other / body.scale) ** 2)
        gain = np.where(both, loss, 0.0)
        totals = [gain[..., limb].sum(-1) / max(len(limb) / 2, 1) for limb in self.limbs]
        self.gain = np.stack(totals, axis=-1)
        exchanged = self._smooth(self.past_gain, self.gain, exchange.window_s) > exchange.gain
        if not exchanged.any():
            return residual
        order = np.array(self.order)
        for number, limb in enumerate(self.limbs):
            mask = exchanged[..., number, None]
            order[..., limb] = np.where(mask, self.mirror[list(limb)], order[..., limb])
        self.order = order
        self.current = given.exchange(order)
        return self.current.residuals(self.points)

    def _smooth(
        self, past: Float[Array, "H ..."], now: Float[Array, "K ..."], window_s: float
    ) -> Float[Array, "K ..."]:
        """Return values of the window, averaged over time with a Gaussian."""
        weights = _gaussian(len(past), len(now), window_s * self.clock.rate_hz)
        values = np.concatenate((past, now))
        average = weights @ values.reshape(len(values), -1)
        return average.reshape(now.shape)

    def _keep(
        self, past: Float[Array, "H ..."], now: Float[Array, "K ..."], window_s: float
    ) -> Float[Array, "h ..."]:
        """Return the past with the oldest of the values now, as far as an average reaches."""
        count = 1 + int(_REACH * window_s * self.clock.rate_hz)
        return np.concatenate((past, now[:1]))[-count:]

    def _accelerations(self) -> Float[Array, "K-2 J"]:
        """Return the precisions of second differences, mm^-2."""
        motion = self.settings.motion
        inner = max(len(self) - 2, 0)
        square = np.concatenate((self.past_square, self.squares))
        deviation = np.full((inner, square.shape[1]), motion.first)
        if inner and len(square):
            sigma = motion.window_s * self.clock.rate_hz
            weights = _gaussian(len(self.past_square), inner, sigma)[:, : len(square)]
            mean = weights @ square / weights.sum(1, keepdims=True)
            deviation = motion.factor * np.sqrt(mean) / self.unit
        limited: Array = deviation.clip(motion.least, motion.most)
        return (limited * self.unit) ** -2.0

    def _squares(self) -> Float[Array, "K-2 J"]:
        points = self.points
        second = points[2:] - 2 * points[1:-1] + points[:-2]
        square: Array = (second * second).sum(-1) / 3
        return square

    def _across(self, points: Float[Array, "*K J 3"]) -> Float[Array, "*K B 3"]:
        start, end = self.ends
        across: Array = points[..., start, :] - points[..., end, :]
        return across

    def _near(self) -> Bool[Array, " B"]:
        """Return which bones count: both ends have been placed of late."""
        reach = round(self.solver.bones.reach_s * self.clock.rate_hz) * self.clock.step
        lately: Array = self.frames[0].number - self.placed_at <= reach
        return lately | np.asarray(self._placed_bones.any(0))

    @property
    def _placed_bones(self) -> Bool[Array, "K B"]:
        start, end = self.ends
        both: Array = self.alone.placed[:, start] & self.alone.placed[:, end]
        return both

    def _place(self, new: Stack, rig: Rig, body: RunningBody) -> tuple[Float[Array, "J 3"], Alone]:
        """Return where a new frame begins, and what it says on its own.

        That is for each joint the most likely of the hypotheses: where the motion goes on to, and
        the points of pairs of views. The motion has a say of its own, as if it were a view.
        """
        points = self.points
        predicted = points[-1] if len(points) < 2 else 2 * points[-1] - points[-2]
        used = new.used[0]
        one, other = _pairs(len(rig.focal), self.settings.pairs)
        matrix = new.gram[0, one] + new.gram[0, other]
        trace = np.trace(matrix[..., :3, :3], axis1=-2, axis2=-1)
        ridge = (_SINGULAR * trace + 1e-300)[..., None, None] * np.eye(3)
        pairs = np.linalg.solve(matrix[..., :3, :3] + ridge, -matrix[..., :3, 3:])[..., 0]
        both = used[one] & used[other]
        candidates = np.concatenate((predicted[None], pairs))
        residual = residual_lengths(new.rows, candidates)
        limit = self.settings.trajectory.agree * body.scale
        fits = used & (rig.depth(candidates) > 0)
        merit = (fits / (1 + (residual / limit) ** 2)).sum(1)
        merit[1:] = np.where(both, merit[1:], -1.0)
        best = merit[1:].argmax(0)
        alone = pairs[best, self.as_given]
        alone_merit = np.maximum(merit[1:].max(0), 0.0)
        within = (fits & (residual <= limit)).sum(1)[1:]
        placed = (both & (within >= 2)).any(0)
        merit += 1 / (1 + (_lengths(candidates - predicted) / limit) ** 2)
        start = candidates[merit.argmax(0), self.as_given]
        alone = np.where(alone_merit[:, None] > 0, alone, start)
        return start, Alone(alone[None], placed[None], alone_merit[None])


def _are_equal(one: Cameras, other: Cameras) -> bool:
    if one is other:
        return True
    pairs = ((one.t, other.t), (one.R, other.R), (one.K, other.K))
    return all(torch.equal(*pair) for pair in pairs)


def _lengths(vectors: Float[Array, "*B 3"]) -> Float[Array, "*B"]:
    length: Array = np.sqrt((vectors * vectors).sum(-1))
    return length


@lru_cache(maxsize=16)
def _groups(joints: int, bones: tuple[tuple[int, int], ...], largest: int) -> tuple[Group, ...]:
    parts = body_groups(joints, bones, largest)
    groups = []
    for members in (*parts.even, *parts.odd):
        inside = set(members)
        inner = [number for number, ends in enumerate(bones) if inside.issuperset(ends)]
        groups.append(Group(members, bones, tuple(inner)))
    return tuple(groups)


@lru_cache(maxsize=16)
def _pairs(views: int, most: int) -> tuple[Int[Array, " P"], Int[Array, " P"]]:
    """Return pairs of views: all of them if they are few, else so many, evenly spread."""
    one, other = np.triu_indices(views, 1)
    if len(one) <= most:
        return one, other
    order = np.random.default_rng(0).permutation(len(one))[:most]
    return one[order], other[order]


@lru_cache(maxsize=512)
def _gaussian(past: int, now: int, sigma: float) -> Float[Array, "K H+K"]:
    """Return the weights of a Gaussian average over the frames that there are."""
    frame = np.arange(past + now)
    distance = (frame[past:, None] - frame) / max(sigma, 1e-9)
    weights = np.where(np.abs(distance) <= _REACH, np.exp(-0.5 * distance**2), 0.0)
    return weights / weights.sum(1, keepdims=True)


def _median(relative: Float[Array, "K V J"], used: Bool[Array, "K V J"]) -> Float[Array, "K V"]:
    """Return the median over the used joints of each view; 0 where there is none."""
    ordered = np.sort(np.where(used, relative, np.inf), axis=-1)
    count = used.sum(-1)
    middle = np.maximum(count - 1, 0) // 2
    found = np.take_along_axis(ordered, middle[..., None], -1)[..., 0]
    return np.where(count > 0, found, 0.0)


def _interpolate(
    points: Float[Array, "K J 3"], placed: Bool[Array, "K J"]
) -> Float[Array, "K J 3"]:
    """Return the points with each missing one at the joint's nearest in time, or at the middle."""
    everywhere = points[placed].mean(0)
    result = np.empty_like(points)
    frame = np.arange(len(points))
    for joint in range(points.shape[1]):
        known = np.flatnonzero(placed[:, joint])
        if not len(known):
            result[:, joint] = everywhere
            continue
        nearest = np.abs(frame[:, None] - known).argmin(1)
        result[:, joint] = points[known[nearest], joint]
    return result
