"""Whether a joint has a position, and if not, why."""

from __future__ import annotations

from enum import IntEnum


class State(IntEnum):
    """What a joint of a frame is; its number is what files hold.

    Joints up to FILLED have a position. Where several reasons apply, a triangulation gives the
    first of BAD_INPUT, FEW_VIEWS, PARALLEL, BEHIND, NOT_CONVERGED.
    """

    message: str
    """What the state means, as a sentence without its full stop."""

    def __new__(cls, number: int, message: str) -> State:
        member = int.__new__(cls, number)
        member._value_ = number
        member.message = message
        return member

    OBSERVED = 0, "it is triangulated from this frame's key points"
    SUPPORTED = 1, "one view sees it, and the frames around and the bones carry it"
    FILLED = 2, "it is interpolated between observed frames, on request"
    FEW_VIEWS = 3, "fewer than two views see it"
    PARALLEL = 4, "the rays that see it are parallel or from one centre, and fix no point"
    BEHIND = 5, "the rays that see it meet behind a camera"
    BAD_INPUT = 6, "a key point, weight or camera is not finite, absurdly large or not a camera"
    REJECTED = 7, "no two views explain it, so wherever it were put would be made up"
    NOT_CONVERGED = -1, "an iterative estimator stopped at its limit; the point is its last"

    @property
    def words(self) -> str:
        """The name as a report prints it."""
        return self.name.lower().replace("_", " ")


FILE_STATES = tuple(state for state in State if state >= State.OBSERVED)
"""The states that a reconstruction has: NOT_CONVERGED is a triangulation's alone."""
