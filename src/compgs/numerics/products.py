"""Products of small matrices in kernels, without BLAS.

`np.dot` in a kernel calls BLAS through scipy, and finds no other: a program that only renders would have to bring it,
and for matrices as small as those of the prediction networks a call takes longer than what it does. Here a block of
ROWS x 16 results stays in vector registers while the sum runs (docs/results/speed.md).

Each result is summed in the order of the columns of `a`, one fused multiply-add a term: it depends neither on the
number of rows nor on what else is computed.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.registry import cpu_target
from numba.extending import intrinsic

from compgs.numerics.compiled import njit


def _rows() -> int:
    """Return the rows of a block of 16 columns: eight sums at once, a vector register each, hide how long one takes."""
    features = str(cpu_target.target_context.codegen().magic_tuple()[2])
    return 8 if "+avx512f" in features else 4


ROWS = _rows()  # no result depends on it
# Of a block of fewer columns, whose rows are one register at most.
NARROW_ROWS = 8

_INDEX, _BYTE, _FLOAT = ir.IntType(32), ir.IntType(8), ir.FloatType()


def _block(rows: int, columns: int, *, adds: bool = False) -> Any:
    """block(a, b, out, i, j): out[i : i + rows, j : j + columns] = a[i : i + rows] b[:, j : j + columns], or += with
    `adds`.
    """

    def block(typing_context: Any, a: Any, b: Any, out: Any, i: Any, j: Any) -> Any:
        if not all(
            isinstance(t, types.Array) and t.dtype == types.float32 and t.ndim == 2 for t in (a, b, out)
        ):
            return None
        return types.void(a, b, out, i, j), _generator(rows, columns, adds)

    return intrinsic(block)


def _generator(rows: int, columns: int, adds: bool) -> Callable[..., Any]:
    vector = ir.VectorType(_FLOAT, columns)
    nothing = ir.Constant(vector, ir.Undefined)
    first_everywhere = ir.Constant(ir.VectorType(_INDEX, columns), [0] * columns)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        a, b, out = (
            context.make_array(kind)(context, builder, value)
            for kind, value in zip(signature.args[:3], arguments[:3], strict=True)
        )
        i, j = arguments[3:]

        def place(array: Any, row: Any, column: Any, kind: Any) -> Any:
            down, across = cgutils.unpack_tuple(builder, array.strides)  # bytes
            offset = builder.add(builder.mul(row, down), builder.mul(column, across))
            start = builder.bitcast(array.data, _BYTE.as_pointer())
            return builder.bitcast(builder.gep(start, [offset]), kind.as_pointer())

        multiply_add = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(vector, [vector] * 3), f"llvm.fmuladd.v{columns}f32"
        )
        own = [builder.add(i, ir.Constant(i.type, row)) for row in range(rows)]
        zero = ir.Constant(vector, None)
        sums = [
            cgutils.alloca_once_value(
                builder, builder.load(place(out, row, j, vector), align=4) if adds else zero
            )
            for row in own
        ]
        terms = cgutils.unpack_tuple(builder, a.shape)[1]
        with cgutils.for_range(builder, terms) as loop:
            weights = builder.load(place(b, loop.index, j, vector), align=4)
            for row, total in zip(own, sums, strict=True):
                factor = builder.load(place(a, row, loop.index, _FLOAT))
                factors = builder.insert_element(nothing, factor, ir.Constant(_INDEX, 0))
                factors = builder.shuffle_vector(factors, nothing, first_everywhere)
                builder.store(builder.call(multiply_add, [factors, weights, builder.load(total)]), total)
        for row, total in zip(own, sums, strict=True):
            builder.store(builder.load(total), place(out, row, j, vector), align=4)
        return context.get_dummy_value()

    return generate


_by_16 = _block(ROWS, 16)
_by_8, _by_4, _by_1 = (_block(NARROW_ROWS, columns) for columns in (8, 4, 1))
_row_by_16, _row_by_8, _row_by_4, _row_by_1 = (_block(1, columns) for columns in (16, 8, 4, 1))
_add_by_16 = _block(ROWS, 16, adds=True)
_add_by_8, _add_by_4, _add_by_1 = (_block(NARROW_ROWS, columns, adds=True) for columns in (8, 4, 1))
_add_row_by_16, _add_row_by_8, _add_row_by_4, _add_row_by_1 = (
    _block(1, columns, adds=True) for columns in (16, 8, 4, 1)
)


@njit
def multiply(a, b, out):  # [N, K], [K, C], [N, C] float32; the columns of b and out lie side by side
    """out = a b."""
    columns = b.shape[1]
    j = 0
    while j + 16 <= columns:
        for i in range(0, len(a) - ROWS + 1, ROWS):
            _by_16(a, b, out, i, j)
        for i in range(len(a) - len(a) % ROWS, len(a)):
            _row_by_16(a, b, out, i, j)
        j += 16
    if j + 8 <= columns:
        for i in range(0, len(a) - NARROW_ROWS + 1, NARROW_ROWS):
            _by_8(a, b, out, i, j)
        for i in range(len(a) - len(a) % NARROW_ROWS, len(a)):
            _row_by_8(a, b, out, i, j)
        j += 8
    if j < columns and columns >= 4:
        # The last ones in fours, of which some are computed again, to the same bits.
        while j < columns:
            j = min(j, columns - 4)
            for i in range(0, len(a) - NARROW_ROWS + 1, NARROW_ROWS):
                _by_4(a, b, out, i, j)
            for i in range(len(a) - len(a) % NARROW_ROWS, len(a)):
                _row_by_4(a, b, out, i, j)
            j += 4
    while j < columns:
        for i in range(0, len(a) - NARROW_ROWS + 1, NARROW_ROWS):
            _by_1(a, b, out, i, j)
        for i in range(len(a) - len(a) % NARROW_ROWS, len(a)):
            _row_by_1(a, b, out, i, j)
        j += 1


@njit
def add_product(a, b, out):  # [N, K], [K, C], [N, C] float32; the columns of b and out lie side by side
    """out += a b."""
    columns = b.shape[1]
    j = 0
    while j + 16 <= columns:
        for i in range(0, len(a) - ROWS + 1, ROWS):
            _add_by_16(a, b, out, i, j)
        for i in range(len(a) - len(a) % ROWS, len(a)):
            _add_row_by_16(a, b, out, i, j)
        j += 16
    if j + 8 <= columns:
        for i in range(0, len(a) - NARROW_ROWS + 1, NARROW_ROWS):
            _add_by_8(a, b, out, i, j)
        for i in range(len(a) - len(a) % NARROW_ROWS, len(a)):
            _add_row_by_8(a, b, out, i, j)
        j += 8
    if j + 4 <= columns:
        for i in range(0, len(a) - NARROW_ROWS + 1, NARROW_ROWS):
            _add_by_4(a, b, out, i, j)
        for i in range(len(a) - len(a) % NARROW_ROWS, len(a)):
            _add_row_by_4(a, b, out, i, j)
        j += 4
    while j < columns:
        for i in range(0, len(a) - NARROW_ROWS + 1, NARROW_ROWS):
            _add_by_1(a, b, out, i, j)
        for i in range(len(a) - len(a) % NARROW_ROWS, len(a)):
            _add_row_by_1(a, b, out, i, j)
        j += 1


@njit
def padded(b):
    """b [K, C] with columns of zeros, up to 4, 8 or a multiple of 16: products with other widths take longer than with
    the next of these.
    """
    terms, columns = b.shape
    wide = np.zeros(
        (terms, 4 if columns <= 4 else 8 if columns <= 8 else (columns + 15) // 16 * 16), np.float32
    )
    for i in range(terms):
        for j in range(columns):
            wide[i, j] = b[i, j]
    return wide
