"""Key points as arrays, with or without the names of their views and frames around them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from ghpt.errors import check


@dataclass(frozen=True)
class KeyPoints:
    """Arrays of key points with any leading dimensions; the last is the joint."""

    pixels: Float[np.ndarray, "*B K 2"]
    confidence: Float[np.ndarray, "*B K"]
    """In [0, 1]; 1 where the detector gives none."""
    valid: Bool[np.ndarray, "*B K"]

    def __len__(self) -> int:
        return len(self.valid)

    def __getitem__(self, index: Any) -> KeyPoints:
        """Index the leading dimensions."""
        return KeyPoints(self.pixels[index], self.confidence[index], self.valid[index])

    def mask_invalid(self) -> KeyPoints:
        """Return the key points as float32, with zeros where they are not valid."""
        pixels = np.where(self.valid[..., None], self.pixels, 0).astype(np.float32)
        confidence = np.where(self.valid, self.confidence, 0).astype(np.float32)
        return KeyPoints(pixels, confidence, self.valid)

    def select(self, key_points: Sequence[int]) -> KeyPoints:
        """Return some of the key points, in this order."""
        at = list(key_points)
        return KeyPoints(self.pixels[..., at, :], self.confidence[..., at], self.valid[..., at])

    def take(self, chosen: Int[np.ndarray, "*S"]) -> KeyPoints:
        """Return the key points of these indices, [*S K]; nothing is valid where one is -1."""
        pixels = _take(self.pixels, chosen)
        confidence = _take(self.confidence, chosen)
        return KeyPoints(pixels, confidence, _take(self.valid, chosen))

    def above(self, least_confidence: float) -> KeyPoints:
        """Return the key points, of which those below this confidence are not valid.

        Raises GhptConfigError for a limit outside of [0, 1].
        """
        problem = f"is {least_confidence:g}"
        hint = "Give a confidence from 0 (all key points) to 1."
        check(0 <= least_confidence <= 1, "least_confidence", problem, hint)
        return replace(self, valid=self.valid & (self.confidence >= least_confidence))

    @staticmethod
    def stack(views: Sequence[KeyPoints]) -> KeyPoints:
        """Return the key points [T K] of V views as [T V K]."""
        return KeyPoints(
            pixels=np.stack([view.pixels for view in views], axis=1),
            confidence=np.stack([view.confidence for view in views], axis=1),
            valid=np.stack([view.valid for view in views], axis=1),
        )


def _take(values: np.ndarray, chosen: Int[np.ndarray, "*S"]) -> np.ndarray:
    there = chosen >= 0
    taken = np.zeros((*chosen.shape, *values.shape[1:]), values.dtype)
    taken[there] = values[chosen[there]]
    return taken
