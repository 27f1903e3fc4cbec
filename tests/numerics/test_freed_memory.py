"""Freed memory is kept, or goes back, as it is asked: the kernel says how much a process holds and faults in."""

import ctypes
import mmap
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from compgs.numerics.freed_memory import give_back_freed

MEGABYTES = 80  # above what glibc would keep by itself
STATUS = Path("/proc/self/status")

pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or platform.libc_ver()[0] != "glibc", reason="about glibc"
)


def resident() -> int:
    """Bytes."""
    line = next(line for line in STATUS.read_text().splitlines() if line.startswith("VmRSS:"))
    return int(line.split()[1]) * 1024


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


def faults_of_an_array(megabytes: int = MEGABYTES) -> int:
    import resource

    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    # (not numpy's own allocation, which asks for huge pages)
    library = ctypes.CDLL(None)
    library.malloc.restype, library.free.argtypes = ctypes.c_void_p, (ctypes.c_void_p,)
    library.malloc.argtypes = (ctypes.c_size_t,)
    place = library.malloc(megabytes << 20)
    np.ctypeslib.as_array((ctypes.c_uint8 * (megabytes << 20)).from_address(place))[:: mmap.PAGESIZE] = 1
    library.free(place)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def in_a_fresh_process(program: str) -> list[int]:
    """Numbers that a program prints; here the heap may hold what other tests have freed."""
    folder = str(Path(__file__).parent)
    start = f"""
import sys
sys.path.insert(0, {folder!r})
from test_freed_memory import faults_of_an_array
from compgs.numerics.freed_memory import freed_memory_kept
"""
    done = subprocess.run([sys.executable, "-c", start + program], capture_output=True, text=True, check=True)
    return [int(number) for number in done.stdout.split()]


def test_an_array_of_the_size_of_the_last_one_takes_its_memory() -> None:
    program = """
with freed_memory_kept():
    faults_of_an_array()
    print(faults_of_an_array())
"""
    (faults,) = in_a_fresh_process(program)
    assert faults < 100


def test_afterwards_memory_goes_back_to_the_system() -> None:
    """That of the array before, and of later ones. These are larger: the place of the first may be between others."""
    program = f"""
with freed_memory_kept():
    faults_of_an_array()
print(faults_of_an_array(), faults_of_an_array({2 * MEGABYTES}), faults_of_an_array({2 * MEGABYTES}))
"""
    assert min(in_a_fresh_process(program)) > (MEGABYTES << 20) // mmap.PAGESIZE // 2
