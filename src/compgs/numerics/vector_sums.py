"""Sums that a compiler may vectorize, in kernels that otherwise compute exactly what they say.

A loop that adds up floats is vectorized only where their order is free (LLVM's `reassoc`). Given to a whole kernel,
that freedom lets the compiler reorder every expression in it, and numba optimizes a parallel kernel once when it is
compiled and once more for its cache: the first process on a machine then rounds otherwise than all later ones, and the
same seed gives another file. So only the additions that need it are free.
"""

from typing import Any

from numba import types
from numba.extending import intrinsic


def _addition(typing_context: Any, total: Any, value: Any) -> Any:
    if not isinstance(total, types.Float) or total != value:
        return None

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fadd(*arguments, flags=("contract", "reassoc", "nsz"))

    return total(total, value), generate


# total + value of one float type, in a kernel; the compiler may choose the order of a loop's additions.
add_in_any_order: Any = intrinsic(_addition)
