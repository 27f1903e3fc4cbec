import ctypes
import mmap
import platform
import sys

import numpy as np
import pytest

from compgs.training.allocation import freed_memory_kept

MEGABYTES = 80  # above what glibc would keep by itself

pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or platform.libc_ver()[0] != "glibc", reason="about glibc"
)


def faults_of_an_array() -> int:
    import resource

    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    # (not numpy's own allocation, which asks for huge pages)
    library = ctypes.CDLL(None)
    library.malloc.restype, library.free.argtypes = ctypes.c_void_p, (ctypes.c_void_p,)
    library.malloc.argtypes = (ctypes.c_size_t,)
    place = library.malloc(MEGABYTES << 20)
    np.ctypeslib.as_array((ctypes.c_uint8 * (MEGABYTES << 20)).from_address(place))[:: mmap.PAGESIZE] = 1
    library.free(place)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def test_an_array_of_the_size_of_the_last_one_takes_its_memory():
    with freed_memory_kept():
        faults_of_an_array()
        assert faults_of_an_array() < 100


def test_afterwards_memory_goes_back_to_the_system():
    with freed_memory_kept():
        faults_of_an_array()
    for _ in range(2):
        assert faults_of_an_array() > (MEGABYTES << 20) // mmap.PAGESIZE // 2
