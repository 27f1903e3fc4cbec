"""Fields of a section: little-endian numbers and variable-length integers (docs/bitstream.md, "Fields").

A varint holds 7 bits a byte, lowest first; the top bit says that another byte follows; the last byte of a
number of two or more bytes is not zero, so that every number has one spelling. A signed number s is stored as
the varint of 2s if s >= 0, else -2s - 1.
"""

import struct

from compgs.errors import CorruptSection


def varint(value: int) -> bytes:
    """Bytes of a non-negative integer."""
    assert value >= 0
    out = bytearray()
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def signed_varint(value: int) -> bytes:
    """Bytes of a signed integer."""
    return varint(2 * value if value >= 0 else -2 * value - 1)


class FieldReader:
    """Reads fields one after the other; what does not fit raises CorruptSection with the section's name."""

    def __init__(self, data: bytes, section: str) -> None:
        self.data = data
        self.section = section
        self.position = 0

    @property
    def remaining(self) -> int:
        """Bytes not read yet."""
        return len(self.data) - self.position

    def bytes(self, count: int, field: str) -> bytes:
        if count > self.remaining:
            raise CorruptSection(
                f"{self.section}: {field} needs {count} bytes at {self.position}, {self.remaining} are left"
            )
        start = self.position
        self.position += count
        return self.data[start : self.position]

    def struct(self, layout: str, field: str) -> tuple:
        return struct.unpack(layout, self.bytes(struct.calcsize(layout), field))

    def varint(self, field: str, lowest: int, highest: int) -> int:
        """A varint from `lowest` to `highest`."""
        value = self._varint(field)
        if not lowest <= value <= highest:
            raise CorruptSection(f"{self.section}: {field} is {value}, expected {lowest} to {highest}")
        return value

    def signed_varint(self, field: str, lowest: int, highest: int) -> int:
        raw = self._varint(field)
        value = -((raw + 1) >> 1) if raw & 1 else raw >> 1
        if not lowest <= value <= highest:
            raise CorruptSection(f"{self.section}: {field} is {value}, expected {lowest} to {highest}")
        return value

    def end(self) -> None:
        """The section must end here."""
        if self.remaining:
            raise CorruptSection(f"{self.section}: {self.remaining} bytes are left over after its last field")

    def _varint(self, field: str) -> int:
        value = 0
        for shift in range(0, 63, 7):
            byte = self.bytes(1, field)[0]
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                if byte == 0 and shift > 0:
                    raise CorruptSection(f"{self.section}: {field} is spelled with a needless zero byte")
                return value
        raise CorruptSection(f"{self.section}: {field} has more than 63 bits")
