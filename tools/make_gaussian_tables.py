"""Writes `src/compgs/codec/gaussian_tables.bin`: the Gaussian streams' frequency tables (docs/bitstream.md).

    python tools/make_gaussian_tables.py [OUTPUT]

The rule, for i = 0 ... 127, in exact arithmetic: sigma = 2^(i/12 - 5) quantization steps,
r = ceil(5 sigma) + 1, P(q) the mass of a normal distribution with standard deviation sigma in
[q - 1/2, q + 1/2], and

    f(q)      = max(1, floor(65536 P(q) + 1/2))              for q = 1 ... r, and f(-q) = f(q)
    f(escape) = max(1, floor(65536 P(|x| > r + 1/2) + 1/2))
    f(0)      = 65536 - 2 (f(1) + ... + f(r)) - f(escape)

50 decimal digits decide every rounding: no value lies within 1e-20 of a tie.
"""

import os
import struct
import sys
import zlib
from pathlib import Path

import mpmath

TABLE_COUNT = 128
TOTAL = 65536
OUTPUT = Path(__file__).parent.parent / "src" / "compgs" / "codec" / "gaussian_tables.bin"


def gaussian_frequencies(i: int) -> tuple[list[int], int]:
    """[f(0), ..., f(r)] and f(escape) of table i."""
    with mpmath.workdps(50):
        sigma = mpmath.power(2, mpmath.mpf(i) / 12 - 5)
        radius = int(mpmath.ceil(5 * sigma)) + 1

        def tail(x: mpmath.mpf) -> mpmath.mpf:  # P(X > x)
            return mpmath.erfc(x / sigma / mpmath.sqrt(2)) / 2

        def rounded(p: mpmath.mpf) -> int:
            scaled = TOTAL * p + mpmath.mpf("0.5")
            assert abs(scaled - mpmath.nint(scaled)) > mpmath.mpf("1e-20") or p < mpmath.mpf("1e-18")
            return max(1, int(mpmath.floor(scaled)))

        half = mpmath.mpf("0.5")
        sides = [rounded(tail(q - half) - tail(q + half)) for q in range(1, radius + 1)]
        escape = rounded(2 * tail(radius + half))
    return [TOTAL - 2 * sum(sides) - escape, *sides], escape


def gaussian_tables_bytes() -> bytes:
    """Per table, little-endian 16-bit numbers: r, f(0), ..., f(r), f(escape)."""
    parts = []
    for i in range(TABLE_COUNT):
        frequencies, escape = gaussian_frequencies(i)
        numbers = [len(frequencies) - 1, *frequencies, escape]
        parts.append(struct.pack(f"<{len(numbers)}H", *numbers))
    return b"".join(parts)


def main() -> None:
    output = Path(sys.argv[1]) if len(sys.argv) > 1 else OUTPUT
    data = gaussian_tables_bytes()
    temporary = output.with_suffix(".tmp")
    temporary.write_bytes(data)
    os.replace(temporary, output)
    print(f"{output.name}: {len(data)} bytes, CRC32 {zlib.crc32(data):#010x}")


if __name__ == "__main__":
    main()
