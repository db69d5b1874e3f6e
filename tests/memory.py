"""What memory a process holds, on Linux, for the tests that nothing leaks."""

import ctypes
import gc
from pathlib import Path

STATUS = Path("/proc/self/status")
_ARENA_MAX = -8
_MMAP_THRESHOLD = -3


def keep_no_freed_memory() -> None:
    """Have glibc give back what is freed: what it keeps differs from run to run by more than a
    leak.
    """
    libc = ctypes.CDLL(None)
    libc.mallopt(_ARENA_MAX, 1)
    libc.mallopt(_MMAP_THRESHOLD, 65536)


def trim() -> None:
    """Free what is garbage, and give back what glibc has kept."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)


def _entry(name: str) -> str:
    lines = STATUS.read_text(encoding="utf-8").splitlines()
    return next(line.split()[1] for line in lines if line.startswith(f"{name}:"))


def private_memory() -> float:
    """Return the MiB that this process itself holds, without mapped files."""
    return int(_entry("RssAnon")) / 1024


def peak_memory() -> float:
    """Return the most MiB that this process has held, with mapped files."""
    return int(_entry("VmHWM")) / 1024


def threads() -> int:
    """Return the number of this process's threads."""
    return int(_entry("Threads"))
