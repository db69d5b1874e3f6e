"""Counter-based randomness: a draw is a pure function of what it is for, never of what was drawn
before.

A key is made of the seed, a purpose and any indices (epoch, sample, ...); every number of a draw is
a hash of its key and its position (SplitMix64's output function applied twice, Steele et al. 2014).
So a frame's hypotheses are the same in any batch, on any process, on CPU or GPU, and after any
resume, without generator state to save.
"""

import zlib

import torch
from jaxtyping import Float, Int
from torch import Tensor


def _int64(value: int) -> int:
    value %= 1 << 64
    return value - (1 << 64) if value >= 1 << 63 else value


_GOLDEN, _MIX1, _MIX2 = (
    _int64(x) for x in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
)


def _shift(x: Tensor, bits: int) -> Tensor:
    """Logical right shift (torch's is arithmetic)."""
    return (x >> bits) & ((1 << (64 - bits)) - 1)


def _mix(x: Tensor) -> Tensor:
    x = (x ^ _shift(x, 30)) * _MIX1
    x = (x ^ _shift(x, 27)) * _MIX2
    return x ^ _shift(x, 31)


def key(
    seed: int, purpose: str, *indices: int | Int[Tensor, "*B"], device: torch.device | str = "cpu"
) -> Tensor:
    """The key(s) of a draw: one int64 for each element of the (broadcast) indices."""
    state = torch.tensor(_int64(seed), dtype=torch.int64, device=device)
    for part in (zlib.crc32(purpose.encode()), *indices):
        part = (
            part.to(torch.int64)
            if isinstance(part, Tensor)
            else torch.tensor(_int64(part), device=device)
        )
        state = _mix(_mix(state * _GOLDEN + _GOLDEN).to(part.device) ^ (part * _GOLDEN))
    return state


def bits(keys: Int[Tensor, "*B"], shape: tuple[int, ...]) -> Int[Tensor, "..."]:
    """64 random bits for each key and position: [*B, *shape] int64."""
    count = 1
    for size in shape:
        count *= size
    position = torch.arange(1, count + 1, dtype=torch.int64, device=keys.device) * _GOLDEN
    return _mix(_mix(keys[..., None] + position)).reshape(*keys.shape, *shape)


def uniform(
    keys: Int[Tensor, "*B"], shape: tuple[int, ...], dtype: torch.dtype = torch.float64
) -> Float[Tensor, "..."]:
    """Uniform numbers in the open interval (0, 1): [*B, *shape]. Neither end occurs, so logs are
    finite.
    """
    digits = 52 if dtype == torch.float64 else 23
    return (_shift(bits(keys, shape), 64 - digits).to(dtype) + 0.5) * 2.0**-digits


def gumbel(keys: Int[Tensor, "*B"], shape: tuple[int, ...]) -> Float[Tensor, "..."]:
    """Gumbel(0, 1) numbers, float64: [*B, *shape]."""
    return -torch.log(-torch.log(uniform(keys, shape)))


def permutation(seed: int, purpose: str, epoch: int, count: int) -> Int[Tensor, " N"]:
    """A random order of ``count`` items, a pure function of its arguments."""
    return torch.argsort(bits(key(seed, purpose, epoch), (count,)), stable=True)
