"""What this machine's memory is told."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

HEAPS = """
import re, sys, threading
from deepshade.machine import share_heaps
if sys.argv[1] == "share":
    share_heaps()
held, wait = [], threading.Barrier(9)
def work():
    held.append([bytearray(5000) for _ in range(50)])
    wait.wait()
threads = [threading.Thread(target=work) for _ in range(8)]
[thread.start() for thread in threads]
ends = [map(lambda at: int(at, 16), line.split()[0].split("-")) for line in open("/proc/self/maps")]
ends = [tuple(each) for each in ends]
whole = sum(a[0] % 2**26 == 0 and b[1] - a[0] == 2**26 for a, b in zip(ends, ends[1:]))
print(whole)
wait.wait()
"""


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="not Linux")
def test_threads_share_two_heaps() -> None:
    """Those of threads are regions of 64 MiB, part of which can be written to."""
    found = {}
    for how in ("share", "own"):
        command = [sys.executable, "-c", HEAPS, how]
        environment = {k: v for k, v in os.environ.items() if k != "MALLOC_ARENA_MAX"}
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, env=environment)
        assert done.returncode == 0, done.stderr
        found[how] = int(done.stdout)
    assert found["share"] <= 2 < found["own"]
