"""Which frames of the views were taken at one time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ghpt.errors import check


@dataclass(frozen=True)
class Clock:
    """At frame n of the rig, view v is at its own frame ``rate[v] * n + shift[v]``.

    A shift is in the view's own frames and need not be whole: positive where the view started
    earlier than the rig. A rate of 0.5 is that of a view with half as many frames as the rig.
    """

    rate: tuple[float, ...]
    shift: tuple[float, ...]

    def __post_init__(self) -> None:
        same = len(self.rate) == len(self.shift)
        check(same, "time", "has not one rate for each shift", "Give both of each view.")
        positive = all(0 < rate < float("inf") for rate in self.rate)
        check(positive, "time", f"has rates {self.rate}", "They must be positive.")
        finite = all(abs(shift) < float("inf") for shift in self.shift)
        check(finite, "time", f"has shifts {self.shift}", "They must be finite.")

    def __len__(self) -> int:
        return len(self.rate)

    @classmethod
    def synchronised(cls, views: int) -> Clock:
        """Return the clock of views whose frames of one number were taken at one time."""
        return cls((1.0,) * views, (0.0,) * views)

    @property
    def is_synchronised(self) -> bool:
        """Whether frames of one number were taken at one time."""
        return all(rate == 1 for rate in self.rate) and not any(self.shift)

    def split(self) -> tuple[tuple[int, ...], Clock]:
        """Return the shifts by whole frames, and the clock of what is left once they are undone;
        nothing is undone where a view has another rate.
        """
        if any(rate != 1 for rate in self.rate):
            return (0,) * len(self), self
        whole = tuple(round(shift) for shift in self.shift)
        rest = tuple(shift - by for shift, by in zip(self.shift, whole, strict=True))
        return whole, Clock(self.rate, rest)

    def select(self, views: Sequence[int]) -> Clock:
        """Return the clock of some of the views, in this order."""
        rate = tuple(self.rate[view] for view in views)
        return Clock(rate, tuple(self.shift[view] for view in views))
