"""Memory in gaps between small arrays goes back to the system: the kernel says how much the process holds."""

import ctypes
from pathlib import Path

import numpy as np
import pytest

from compgs.numerics.freed_memory import give_back_freed

STATUS = Path("/proc/self/status")


def resident() -> int:
    """Bytes."""
    line = next(line for line in STATUS.read_text().splitlines() if line.startswith("VmRSS:"))
    return int(line.split()[1]) * 1024


@pytest.mark.skipif(
    not STATUS.is_file() or not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="needs Linux with glibc"
)
def test_gaps_between_arrays_that_stay_go_back_to_the_system() -> None:
    large, small = [], []
    for _ in range(1_000):  # 100 kB: glibc maps none of these on its own
        large.append(np.ones(100_000, np.uint8))
        small.append(np.ones(2_000, np.uint8))
    large.clear()
    before = resident()
    give_back_freed()
    assert before - resident() > 80e6
    assert all(array.all() for array in small)
