"""Damaged and forged files thrown at the decoder.

    python benchmarks/fuzz.py [--seconds 60] [--seed 0] [FILE ...]

Every file must be refused with a BitstreamError or, where the forger made its checksums right again, be a
content that can be written. Anything else (another exception, seconds of work for a few kilobytes) is a
failure; the offending file is kept as `fuzz-SEED-NUMBER.cgs`. If the process itself dies, the file that
killed it is `fuzz-last.cgs`.
"""

import argparse
import resource
import struct
import sys
import time
import zlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from compgs.codec.format import SCENE, Section, container_bytes, pack, unpack
from compgs.codec.reader import file_info, read_content
from compgs.codec.writer import write_content
from compgs.errors import BitstreamError

GOLDEN = Path(__file__).parent.parent / "tests" / "golden"
SLOW_SECONDS = 5.0


def truncated(rng: np.random.Generator, data: bytes, other: bytes) -> bytes:
    return data[: rng.integers(len(data))]


def flipped(rng: np.random.Generator, data: bytes, other: bytes) -> bytes:
    """A few bits flipped; checksums stay as they were."""
    out = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        out[rng.integers(len(out))] ^= 1 << rng.integers(8)
    return bytes(out)


def noise(rng: np.random.Generator, data: bytes, other: bytes) -> bytes:
    """Random bytes, sometimes behind a genuine beginning."""
    kept = data[: rng.integers(0, 200)] if rng.random() < 0.7 else b""
    return kept + rng.bytes(rng.integers(0, 3000))


def forged_header(rng: np.random.Generator, data: bytes, other: bytes) -> bytes:
    """Header bytes changed, its checksum made right again."""
    out = bytearray(data)
    end = container_bytes(out[6]) - 4
    for _ in range(rng.integers(1, 4)):
        out[rng.integers(5, end)] = rng.integers(256)
    if container_bytes(out[6]) <= len(out):
        end = container_bytes(out[6]) - 4
    struct.pack_into("<I", out, end, zlib.crc32(bytes(out[:end])))
    return bytes(out)


def spliced(rng: np.random.Generator, data: bytes, other: bytes) -> bytes:
    """Some sections from another file."""
    theirs = {section.number: section for section in unpack(other)}
    return pack([theirs.get(s.number, s) if rng.random() < 0.3 else s for s in unpack(data)])


def forged_payload(rng: np.random.Generator, data: bytes, other: bytes) -> bytes:
    """Bytes of one section changed, cut or added, all checksums made right again."""
    sections = unpack(data)
    i = int(rng.integers(len(sections)))
    payload = bytearray(sections[i].data)
    for _ in range(rng.integers(1, 4)):
        match rng.integers(5):
            case 0 if payload:
                payload[rng.integers(len(payload))] ^= 1 << rng.integers(8)
            case 1 if payload:
                payload[rng.integers(len(payload))] = rng.integers(256)
            case 2 if payload:
                payload[rng.integers(min(len(payload), 12))] = rng.choice([0, 1, 127, 128, 255])
            case 3:
                payload = payload[: rng.integers(len(payload) + 1)]
            case _:
                payload += rng.bytes(rng.integers(1, 9))
    sections[i] = Section(sections[i].number, bytes(payload))
    return pack(sections)


def forged_scene(rng: np.random.Generator, data: bytes, other: bytes) -> bytes:
    """Absurd counts and dimensions in the scene section, all checksums made right again."""
    sections = unpack(data)
    i = next(i for i, section in enumerate(sections) if section.number == SCENE)
    payload = bytearray(sections[i].data)
    for _ in range(rng.integers(1, 3)):
        place = int(rng.integers(len(payload)))
        payload[place] = rng.choice([0, 1, 2, 64, 127, 128, 254, 255])
    sections[i] = Section(SCENE, bytes(payload))
    return pack(sections)


FORGERS = (truncated, flipped, noise, forged_header, spliced, forged_payload, forged_scene)


def forgeries(files: list[bytes], seed: int) -> Iterator[tuple[str, bytes]]:
    """Endlessly many (kind, file)."""
    rng = np.random.default_rng(seed)
    while True:
        data, other = (files[rng.integers(len(files))] for _ in range(2))
        forger = FORGERS[rng.integers(len(FORGERS))]
        yield forger.__name__, forger(rng, data, other)


def outcome(data: bytes) -> str:
    """Name of the error that the decoder raises, or "accepted"; anything unexpected propagates."""
    try:
        content = read_content(data)
    except BitstreamError as error:
        assert str(error), "an error without a message"
        return type(error).__name__
    file_info(data)
    again = write_content(content)
    assert write_content(read_content(again)) == again, "accepted, but its content does not survive writing"
    return "accepted"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "files", nargs="*", type=Path, help="genuine files to start from (default: the golden files)"
    )
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    paths = options.files or sorted(GOLDEN.glob("*.cgs"))
    files = [path.read_bytes() for path in paths]
    for data in files:
        outcome(data)  # compiles the kernels
    counts: Counter[tuple[str, str]] = Counter()
    slowest = 0.0
    failures = 0
    last = Path("fuzz-last.cgs")
    stop = time.monotonic() + options.seconds
    for number, (kind, data) in enumerate(forgeries(files, options.seed)):
        if time.monotonic() > stop:
            break
        last.write_bytes(data)
        start = time.perf_counter()
        try:
            result = outcome(data)
        except Exception as error:  # whatever is not of the family is what we look for
            result = f"FAILURE {type(error).__name__}: {error}"
        seconds = time.perf_counter() - start
        slowest = max(slowest, seconds)
        if result.startswith("FAILURE") or seconds > SLOW_SECONDS:
            failures += 1
            Path(f"fuzz-{options.seed}-{number}.cgs").write_bytes(data)
            print(f"{number} {kind}: {result} after {seconds:.2f} s, {len(data)} bytes")
        counts[kind, result[:40]] += 1
    last.unlink(missing_ok=True)
    for (kind, result), count in sorted(counts.items()):
        print(f"{kind:16} {result:40} {count}")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    total = sum(counts.values())
    print(f"{total} files, {failures} failures, slowest {slowest:.2f} s, peak memory {peak:.0f} MiB")
    sys.exit(1 if failures else 0)


if __name__ == "__main__":
    main()
