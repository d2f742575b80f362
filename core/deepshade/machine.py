"""What this process may use of the machine, and does: CPUs (also by a quota), and memory."""

from __future__ import annotations

import ctypes
import os
import platform
import sys
from contextlib import suppress
from functools import cache
from pathlib import Path

_CGROUP = Path("/sys/fs/cgroup")
_ARENA_MAX = -8  # malloc.h: M_ARENA_MAX
# What makes one processor of a name several times as fast as another: the first that it has.
_WIDEST = {"amx_tile": "AMX", "avx512f": "AVX-512", "avx2": "AVX2"}


def cpu_quota(root: Path = _CGROUP) -> float | None:
    """CPUs that the cgroup's quota allows (2.5 = two and a half), or None without a quota."""
    try:  # cgroup v2
        quota, period = (root / "cpu.max").read_text().split()[:2]
    except (OSError, ValueError):
        try:  # cgroup v1
            quota = (root / "cpu/cpu.cfs_quota_us").read_text().strip()
            period = (root / "cpu/cpu.cfs_period_us").read_text().strip()
        except OSError:
            return None
    try:
        cpus = float(quota) / float(period)
    except (ValueError, ZeroDivisionError):  # "max": no quota
        return None
    return cpus if cpus > 0 else None


@cache
def cpu_count() -> int:
    """CPUs this process may really use: its affinity, and the container's quota rounded up."""
    try:
        count = len(os.sched_getaffinity(0))
    except AttributeError:  # not on macOS or Windows
        count = os.cpu_count() or 1
    quota = cpu_quota()
    return max(1, count if quota is None else min(count, int(quota + 0.99)))


def memory_bytes(root: Path = _CGROUP) -> int:
    """Memory this process may use: the machine's, or the container's limit if that is less."""
    total = 0
    with suppress(AttributeError, ValueError, OSError):  # not on Windows
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    for name in ("memory.max", "memory/memory.limit_in_bytes"):
        try:
            limit = int((root / name).read_text())
        except (OSError, ValueError):
            continue
        return min(total, limit) if total else limit
    return total


def resident() -> int:
    """Bytes of this process in physical memory; 0 where the system doesn't say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:  # not Linux
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def trim() -> None:
    """Return freed memory to the system. glibc otherwise keeps what lies below its heap's top."""
    if sys.platform.startswith("linux"):
        with suppress(OSError, AttributeError):  # musl has no malloc_trim
            ctypes.CDLL(None).malloc_trim(0)


def share_heaps() -> None:
    """Let threads share two heaps; $MALLOC_ARENA_MAX says another number.

    glibc gives each thread one, and pictures that wander from thread to thread leave holes in all.
    """
    if sys.platform.startswith("linux") and "MALLOC_ARENA_MAX" not in os.environ:
        with suppress(OSError, AttributeError):  # musl has no mallopt
            ctypes.CDLL(None).mallopt(_ARENA_MAX, 2)


def describe() -> str:
    """The processor, its widest instructions and the CPUs we may use, for benchmarks and cards."""
    model = _cpuinfo("model name") or platform.processor() or platform.machine()
    widest = next((f" ({name})" for flag, name in _WIDEST.items() if flag in cpu_flags()), "")
    return f"{model}{widest}, {cpu_count()} CPUs"


@cache
def cpu_flags() -> frozenset[str]:
    """The instruction sets of the CPU, as Linux calls them; empty where it doesn't say."""
    return frozenset((_cpuinfo("flags") or _cpuinfo("Features")).split())


def cpu_kind() -> str:
    """The CPU's instructions for 8-bit products: "amx", "vnni", or neither: its architecture.

    Libraries have kernels for each, so a precision's error on one kind says little of another.
    """
    flags = cpu_flags()
    if "amx_int8" in flags:
        return "amx"
    if flags & {"avx512_vnni", "avx_vnni"}:
        return "vnni"
    return platform.machine()


def _cpuinfo(name: str) -> str:
    """What the system says of its first CPU; empty where it doesn't."""
    with suppress(OSError):  # only on Linux
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            key, _, value = line.partition(":")
            if key.strip() == name:
                return value.strip()
    return ""
