"""The inner loops must be compiled to vector instructions: losing them is silent and costs a factor of ten.

The sources of the kernels are compiled afresh: cached kernels show no assembly.
"""

import platform
import re

import pytest
from numba import float32, int32, int64, njit, types

from compgs.render import projection, tiles

F1, F2, F3 = float32[::1], float32[:, ::1], float32[:, :, ::1]
LIMITS = (float32, float32, float32)
SHARE = types.UniTuple(int64, 2)
KERNELS = {
    "project_forward": (projection, (F2, F2, F2, F1, F2, F2, F1, F1, SHARE)),
    "project_backward": (projection, (F2, F2, F2, F1, F1, F2, F2, F2, F2, F2, SHARE)),
    "blend_forward": (
        tiles,
        (F2, int64[::1], int32[:, ::1], int32[::1], F1, *LIMITS, F3, F2, int64[::1], SHARE),
    ),
    "blend_backward": (
        tiles,
        (F2, int64[::1], int32[:, ::1], int32[::1], int64[::1], *LIMITS, F3, F2, F3, F2, F2, SHARE),
    ),
}
# mul, fma and their variants; "ps" is packed, "ss" scalar
PACKED = re.compile(r"^\s*v?f?n?m(?:ul|add\d*|sub\d*)ps\s", re.MULTILINE)


@pytest.mark.skipif(
    platform.machine().lower() not in ("x86_64", "amd64"), reason="looks for x86 instructions"
)
@pytest.mark.parametrize("name", KERNELS)
def test_inner_loops_use_vector_instructions(name):
    module, signature = KERNELS[name]
    kernel = njit(signature, fastmath=module.FASTMATH, error_model="numpy")(getattr(module, name).py_func)
    assembly = kernel.inspect_asm(kernel.signatures[0])
    # The loop of blend_forward has fifteen, the others more; without it at most six, elsewhere, are left.
    assert len(PACKED.findall(assembly)) >= 12
