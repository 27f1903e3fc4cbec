"""How much of a file to decode: so many bytes, or up to a level of its octree."""

import re
from pathlib import Path

from compgs.cli.inputs import read_bitstream
from compgs.cli.sizes import parse_size
from compgs.cli.usage import UsageError

LEVEL = re.compile(r"level\s*(\d+)", re.IGNORECASE)


def parse_prefix(text: str, file: Path) -> int:
    """Bytes of a `--prefix`: a size such as 20kB, or `level 6`, the last of the file's ranges up to that octree level.

    Raises UsageError that names the option and what the file has; BitstreamError for a damaged file.
    """
    match = LEVEL.fullmatch(text.strip())
    if match is None:
        return parse_size(text, "--prefix")
    from compgs.codec.reader import file_info

    ranges = file_info(read_bitstream(file)).ranges
    reached = [part.bytes for part in ranges if part.level <= int(match[1])]
    if not reached:
        levels = ", ".join(str(part.level) for part in ranges)
        raise UsageError(f"--prefix {text}: the file's ranges end at the levels {levels}")
    return reached[-1]
