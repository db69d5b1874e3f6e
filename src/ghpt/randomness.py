"""Counter-based randomness: a draw is a pure function of what it is for, never of what was drawn
before.

A key is made of the seed, a purpose and any indices (epoch, sample, ...); every number of a draw is
a hash of its key and its position (SplitMix64's output function applied twice, Steele et al. 2014).
So a frame's hypotheses are the same in any batch, on any process, on CPU or GPU, and after any
resume, without generator state to save.
"""

import math
import zlib

import torch
from jaxtyping import Float, Int
from torch import Tensor


def _int64(value: int) -> int:
    """Return the signed 64-bit number of the same bits, modulo 2^64."""
    value %= 1 << 64
    return value - (1 << 64) if value >= 1 << 63 else value


_GOLDEN = _int64(0x9E3779B97F4A7C15)
_MIX1 = _int64(0xBF58476D1CE4E5B9)
_MIX2 = _int64(0x94D049BB133111EB)


def _shift(x: Tensor, bits: int) -> Tensor:
    """Return the logical right shift (torch's is arithmetic)."""
    mask = (1 << (64 - bits)) - 1
    return (x >> bits) & mask


def _mix(x: Tensor) -> Tensor:
    x = (x ^ _shift(x, 30)) * _MIX1
    x = (x ^ _shift(x, 27)) * _MIX2
    return x ^ _shift(x, 31)


def key(
    seed: int,
    purpose: str,
    *indices: int | Int[Tensor, "*B"],
    device: torch.device | str = "cpu",
) -> Int[Tensor, "*B"]:
    """Return the key(s) of a draw: one int64 for each element of the (broadcast) indices."""
    state = torch.tensor(_int64(seed), dtype=torch.int64, device=device)
    for index in (zlib.crc32(purpose.encode()), *indices):
        if isinstance(index, Tensor):
            index = index.to(torch.int64)
        else:
            index = torch.tensor(_int64(index), device=device)
        previous = _mix(state * _GOLDEN + _GOLDEN).to(index.device)
        state = _mix(previous ^ (index * _GOLDEN))
    return state


def bits(keys: Int[Tensor, "*B"], shape: tuple[int, ...]) -> Int[Tensor, "..."]:
    """Return 64 random bits for each key and position: [*B, *shape] int64."""
    count = math.prod(shape)
    position = torch.arange(1, count + 1, dtype=torch.int64, device=keys.device)
    flat = _mix(_mix(keys[..., None] + position * _GOLDEN))
    return flat.reshape(*keys.shape, *shape)


def uniform(
    keys: Int[Tensor, "*B"],
    shape: tuple[int, ...],
    dtype: torch.dtype = torch.float64,
) -> Float[Tensor, "..."]:
    """Return uniform numbers in the open interval (0, 1): [*B, *shape].

    Neither end occurs, so logs are finite.
    """
    digits = 52 if dtype == torch.float64 else 23
    whole = _shift(bits(keys, shape), 64 - digits).to(dtype)
    return (whole + 0.5) * 2.0**-digits


def gumbel(keys: Int[Tensor, "*B"], shape: tuple[int, ...]) -> Float[Tensor, "..."]:
    """Return Gumbel(0, 1) numbers, float64: [*B, *shape]."""
    exponential = -torch.log(uniform(keys, shape))
    return -torch.log(exponential)


def permutation(seed: int, purpose: str, epoch: int, count: int) -> Int[Tensor, " N"]:
    """Return a random order of ``count`` items, a pure function of its arguments."""
    order = bits(key(seed, purpose, epoch), (count,))
    return torch.argsort(order, stable=True)
