"""Random numbers that depend on what they are for, and Gaussian processes in time made of them."""

from __future__ import annotations

import zlib

import numpy as np
from jaxtyping import Float
from scipy.signal import lfilter


def generator(seed: int, *names: str) -> np.random.Generator:
    """Return random numbers that depend on what they are for and on nothing else."""
    keys = [zlib.crc32(name.encode()) for name in names]
    sequence = np.random.SeedSequence([seed, *keys])
    return np.random.Generator(np.random.Philox(sequence))


def gaussian_process(
    rng: np.random.Generator,
    shape: tuple[int, ...],
    frames: int,
    persistence: float,
) -> Float[np.ndarray, "T ..."]:
    """Return stationary unit Gaussian processes, float32, smooth to second order.

    They forget within ``persistence`` frames.
    """
    warm_up = int(np.ceil(6.0 * persistence))
    pole = np.exp(-2.0 / max(persistence, 1e-3))
    gain = np.sqrt((1.0 - pole**2) ** 3 / (1.0 + pole**2))
    white = rng.standard_normal((*shape, frames + warm_up), dtype=np.float32)
    denominator = [1.0, -2.0 * pole, pole**2]
    smooth = lfilter([gain], denominator, white, axis=-1)
    stationary = smooth[..., warm_up:]
    return np.moveaxis(stationary, -1, 0).astype(np.float32)
