"""A person's trajectory while it is recorded: the same terms, over a fixed lag.

The frames of the lag are solved together whenever a new one comes, and what the frames before them
say of the oldest two is carried along as a prior (`fixed_lag`). A frame's result depends on nothing
that comes later than the lag. It is a loop over frames, so arrays are NumPy's, whose calls cost
less than the arithmetic here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from ghpt.errors import check, check_positive
from ghpt.geometry.normal_equations import local_cameras
from ghpt.geometry.state import State
from ghpt.models.estimators.rejection import Rejection
from ghpt.models.estimators.trajectory.disjoint import LEAST_VIEWS
from ghpt.models.estimators.trajectory.estimator import body_size
from ghpt.models.estimators.trajectory.lag_window import LagWindow, WindowSettings
from ghpt.models.estimators.trajectory.running import Memory, RunningBody, measure
from ghpt.models.estimators.trajectory.sightings import Frame, as_observations, blank
from ghpt.models.estimators.trajectory.windows import Clock
from ghpt.reconstruction import Reconstruction

Array = np.ndarray

_LEAST_WINDOW = 3
"""Frames of a window: two that the prior is of, and one that comes."""
_DIAGONAL = (0, 3, 5)
"""Of xx xy xz yy yz zz."""
_FIRST_LESSONS = 5
"""How often the body is measured in the first ``learn_s``."""


@dataclass(frozen=True)
class OnlineSettings(WindowSettings):
    """How a trajectory is estimated while it is recorded.

    A frame is given ``lag_s`` after it was seen. ``inflation`` is that of the variances, in place
    of the trajectory's. Every ``learn_s`` the last ``memory_s`` tell the person's bones and the
    noise, by at most about ``memory_frames``. Nothing is said of joints whose standard deviation,
    of the three coordinates together, is above ``largest_deviation`` (mm).
    """

    lag_s: float
    inflation: float
    learn_s: float
    memory_s: float
    memory_frames: int
    largest_deviation: float

    def __post_init__(self) -> None:
        check(self.lag_s >= 0, "lag", f"is {self.lag_s}", "Give seconds, 0 or more.")
        check_positive(joints=self.joints, pairs=self.pairs, inflation=self.inflation)
        check_positive(learn_s=self.learn_s, memory_s=self.memory_s)
        check_positive(memory_frames=self.memory_frames)
        check_positive(largest_deviation=self.largest_deviation)


@dataclass(frozen=True)
class Estimate:
    """A frame's result."""

    number: int
    points: Float[Array, "J 3"]
    """World, mm."""
    state: Int[Array, " J"]
    error: Float[Array, " J"]
    """Pixels."""
    views: Bool[Array, "V J"]
    covariance: Float[Array, "J 6"]
    """xx xy xz yy yz zz, mm^2."""
    flipped: Bool[Array, " V"]


def as_reconstruction(found: Sequence[Estimate]) -> Reconstruction:
    """Return the results of successive frames, one or more."""

    def stack(name: str, dtype: type) -> torch.Tensor:
        return torch.from_numpy(np.array([getattr(one, name) for one in found], dtype))

    return Reconstruction(
        frame=stack("number", np.int64),
        points=stack("points", np.float64),
        state=stack("state", np.int8),
        error=stack("error", np.float32),
        views=stack("views", np.bool_),
        covariance=stack("covariance", np.float32),
        score=torch.zeros(len(found)),
        flipped=stack("flipped", np.bool_),
    )


class OnlineStream:
    """Takes the frames of one person as they come, and gives each one's result after the lag.

    ``clock`` says how frame numbers tell the time. ``reject``: which joints are REJECTED because
    too few views explain them; None: none.
    """

    def __init__(self, settings: OnlineSettings, reject: Rejection | None, clock: Clock) -> None:
        rate = clock.rate_hz
        self.settings = settings
        self.reject = reject
        self.clock = clock
        self.lag = round(settings.lag_s * rate)
        self.reach = round(settings.trajectory.reach_s * rate) * clock.step
        self.learn = max(1, round(settings.learn_s * rate))
        step = max(1, round(settings.memory_s * rate / settings.memory_frames))
        self.memory = Memory(settings.memory_frames, step, first=self.learn)
        self.body: RunningBody | None = None
        self.size = 1.0
        self.waiting: list[Frame] = []
        """Frames before there is a window."""
        self.window: LagWindow | None = None
        self.given = 0
        """Frames of the window whose results have been given."""
        self.last: Frame | None = None

    def push(self, frame: Frame) -> list[Estimate]:
        """Take the next frame, whose number is above the last one's; return what is ready."""
        ready = []
        last = self.last
        if last is not None and frame.number - last.number > self.clock.longest_gap:
            ready += self.finish()
        elif last is not None:
            step = self.clock.step
            for number in range(last.number + step, frame.number - step + 1, step):
                ready += self._take(blank(last, number))
        self.last = frame
        return ready + self._take(frame)

    def finish(self) -> list[Estimate]:
        """Return the results of the frames that are left: what comes next is another piece."""
        if self.window is None and self.waiting:
            self._begin()
        ready = [_missing(frame) for frame in self.waiting if frame.is_given]
        if self.window is not None:
            ready += self._estimates(self.window, len(self.window))
        self.waiting = []
        self.window = None
        self.last = None
        return ready

    def _take(self, frame: Frame) -> list[Estimate]:
        ready = []
        if self.window is not None:
            if frame.used.any():
                self.seen_at = frame.number
            if frame.number - self.seen_at <= self.clock.longest_gap:
                self.window.push(frame, self._known_body)
                return self._oldest(self.window)
            ready = self._estimates(self.window, len(self.window))
            self.window = None
        self.waiting.append(frame)
        if len(self.waiting) <= self.lag:
            return ready
        self._begin()
        if self.window is not None:
            return ready + self._oldest(self.window)
        gone = self.waiting.pop(0)
        return [*ready, _missing(gone)] if gone.is_given else ready

    def _begin(self) -> None:
        """Begin a window with the frames that wait, if they show anybody, frame by frame."""
        frames = self.waiting
        if not any((frame.used.sum(0) >= 2).any() for frame in frames):
            return
        first = self.settings.trajectory.start(as_observations(frames))
        placed = first.estimated & first.points.isfinite().all(-1)
        if not placed.any():
            return
        if self.size == 1:
            self.size = body_size(first)
        _, origin = local_cameras(frames[0].cameras)
        self.window = LagWindow(
            settings=self.settings,
            clock=self.clock,
            frames=frames,
            points=first.points.double().numpy(),
            placed=placed.numpy(),
            origin=origin,
            size=self.size,
        )
        self.given = 0
        self.waiting = []
        self.seen_at = frames[-1].number
        self.observed_at = np.full(placed.shape[1], -np.inf)
        """Number of the last frame in which each joint was observed."""
        self.window.start(self._measure(self.window))
        self.window.refine(self._measure(self.window))

    def _measure(self, window: LagWindow) -> RunningBody:
        """Measure the body anew, by the frames that are given and those of the window."""
        residual = window.residual
        places = range(self.given, len(window))
        now = [window.sample(place, residual[place]) for place in places]
        samples = [*self.memory.samples, *now]
        self.body = measure(samples, self.settings.trajectory)
        return self.body

    def _oldest(self, window: LagWindow) -> list[Estimate]:
        """Return the result of the frame whose lag is over, and leave the oldest one behind."""
        ready = self._estimates(window, len(window) - self.lag)
        seen = self.memory.seen
        if seen % max(1, self.learn // (1 if seen > self.learn else _FIRST_LESSONS)) == 0:
            self._measure(window)
        if len(window) > max(self.lag, _LEAST_WINDOW - 1):
            window.drop()
            self.given -= 1
        return ready

    def _estimates(self, window: LagWindow, until: int) -> list[Estimate]:
        """Return the results of the first frames of the window that have not been given."""
        residual = window.residual
        limit = self.settings.trajectory.agree * self._known_body.scale
        agrees = window.current.used & (residual <= limit)
        observed = agrees.sum(1) >= 2
        ready = []
        for place in range(self.given, until):
            frame = window.frames[place]
            later = observed[place:].any(0)
            estimate = self._estimate(window, place, residual[place], agrees[place], later)
            if not frame.is_given:
                continue
            if self.memory.takes_next:
                self.memory.samples.append(window.sample(place, residual[place]))
            self.memory.seen += 1
            ready.append(estimate)
        self.given = max(self.given, until)
        return ready

    @property
    def _known_body(self) -> RunningBody:
        assert self.body is not None
        return self.body

    def _estimate(
        self,
        window: LagWindow,
        place: int,
        residual: Float[Array, "V J"],
        agrees: Bool[Array, "V J"],
        later: Bool[Array, " J"],
    ) -> Estimate:
        """Return the result of a frame; the rules of its states are `TrajectoryPredictor`'s.

        ``later``: whether a joint is observed in this frame or a later one.
        """
        frame = window.frames[place]
        rig = window.rigs[place]
        used = window.current.used[place]
        depth = window.depth(place)
        agrees = agrees & (depth > 0)
        fixed = rig.fixed(agrees)
        near = (frame.number - self.observed_at <= self.reach) | later
        self.observed_at = np.where(fixed, frame.number, self.observed_at)
        supported = agrees.any(0) & near & ~fixed
        observed = fixed
        extent = self._known_body.extent
        if self.reject is not None and extent > 0:
            explains = used & (depth > 0) & (residual <= self.reject.limit * extent)
            rays = explains.sum(0)
            observed = observed & (rays >= 2)
            supported = supported & (rays >= 1)
        active = int(window.given.used.any((0, 2)).sum())
        inflation = self.settings.inflation * LEAST_VIEWS / max(active, 2)
        covariance = inflation * window.covariance(place)
        variance = covariance[:, _DIAGONAL].sum(-1)
        known = variance <= (self.settings.largest_deviation * self.size) ** 2
        observed = observed & known
        supported = supported & known
        alone = np.where((used & (depth <= 0)).any(0), State.BEHIND, State.REJECTED)
        alone = np.where(rig.fixed(used), alone, State.PARALLEL)
        reason = np.where(used.sum(0) >= 2, alone, _unseen(frame))
        state = np.where(supported, State.SUPPORTED, reason)
        placed = observed | supported
        views = agrees & placed
        pixels = residual * rig.focal[:, None] / np.where(depth > 0, depth, np.inf)
        square = np.where(views, pixels * pixels, 0.0).sum(0)
        return Estimate(
            number=frame.number,
            points=np.where(placed[:, None], window.world(place), 0.0),
            state=np.where(observed, State.OBSERVED, state),
            error=np.sqrt(square / np.maximum(views.sum(0), 1)),
            views=views,
            covariance=np.where(placed[:, None], covariance, 0.0),
            flipped=(window.order[place] != window.as_given).any(-1),
        )


def _unseen(frame: Frame) -> Int[Array, " J"]:
    """Return why joints that fewer than two views see are missing."""
    return np.where(frame.rejected.any(0), State.BAD_INPUT, State.FEW_VIEWS)


def _missing(frame: Frame) -> Estimate:
    """Return the result of a frame in which nobody is found."""
    views, joints = frame.used.shape
    seen = frame.used.sum(0) >= 2
    return Estimate(
        number=frame.number,
        points=np.zeros((joints, 3)),
        state=np.where(seen, State.REJECTED, _unseen(frame)),
        error=np.zeros(joints),
        views=np.zeros((views, joints), bool),
        covariance=np.zeros((joints, 6)),
        flipped=np.zeros(views, bool),
    )
