"""Values as whole numbers of a few bits between their smallest and their largest, one pair for all of an array.

value = low + code x step, in single precision: `fake_quantization.fake_levels` computes the same on tensors.
"""

from dataclasses import dataclass

import numpy as np

from compgs.formats.packed import Packed


@dataclass(frozen=True, eq=False)
class Levels:
    """An array as it is stored."""

    codes: np.ndarray  # of the array's shape, uint8 or uint16
    low: float
    step: float

    @staticmethod
    def of(values: np.ndarray, bits: int = 8) -> "Levels":
        """Quantize an array [...] float32, with at least one value, to at most 16 bits."""
        assert 1 <= bits <= 16, bits
        low = values.min()
        step = (values.max() - low) / np.float32((1 << bits) - 1)
        step = step if step > 0 else np.float32(1)
        codes = np.rint((values - low) / step).astype(np.uint8 if bits <= 8 else np.uint16)
        return Levels(codes, float(low), float(step))

    def values(self) -> np.ndarray:
        """[...] float32."""
        with np.errstate(over="ignore", invalid="ignore"):  # a damaged file's: whoever reads one checks them
            return np.float32(self.low) + self.codes.astype(np.float32) * np.float32(self.step)

    def facts(self, name: str) -> dict[str, float]:
        """Return what the header of a file says of an array of that name."""
        return {f"{name}.low": self.low, f"{name}.step": self.step}


def stored_levels(packed: Packed, name: str, shape: tuple[int | None, ...], bits: int = 8) -> np.ndarray:
    """[...] float32: the values of an array of a file. Raises SplatFileError for what is none."""
    codes = packed.array(name, np.uint8 if bits <= 8 else np.uint16, shape)
    return Levels(codes, packed.number(f"{name}.low"), packed.number(f"{name}.step")).values()
