"""Random numbers that depend on what they are for, and Gaussian processes in time made of them."""

from __future__ import annotations

import zlib

import numpy as np
from jaxtyping import Float
from scipy.signal import lfilter


def generator(seed: int, *names: str) -> np.random.Generator:
    """Random numbers that depend on what they are for and on nothing else."""
    keys = [seed, *(zlib.crc32(name.encode()) for name in names)]
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(keys)))


def process(
    rng: np.random.Generator, shape: tuple[int, ...], frames: int, persistence: float
) -> Float[np.ndarray, "T ..."]:
    """Stationary unit Gaussian processes, smooth (second order), that forget within ``persistence``
    frames.
    """
    warm = int(np.ceil(6.0 * persistence))
    pole = np.exp(-2.0 / max(persistence, 1e-3))
    gain = np.sqrt((1.0 - pole**2) ** 3 / (1.0 + pole**2))
    white = rng.standard_normal((*shape, frames + warm), dtype=np.float32)
    smooth = lfilter([gain], [1.0, -2.0 * pole, pole**2], white, axis=-1)[..., warm:]
    return np.moveaxis(smooth, -1, 0).astype(np.float32)
