"""Damaged and forged files thrown at the decoder.

    python benchmarks/fuzz.py [--seconds 60] [--seed 0] [FILE ...]

Every file must be refused with a BitstreamError or, where the forger made its checksums right again, be a
content that can be written; read as the beginning of a file, too, of which what is whole decodes. Anything
else (another exception, more time than a file of that length may take) is a failure; the offending file is
kept as `fuzz-SEED-NUMBER.cgs`. If the process itself dies, the file that killed it is `fuzz-last.cgs`.
"""

import argparse
import resource
import struct
import sys
import time
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from itertools import starmap
from pathlib import Path

import numpy as np

from compgs.codec.content import FileContent, GroupShape, Role
from compgs.codec.fields import FieldReader, varint
from compgs.codec.format import (
    FIRST_WITH_DILATION,
    FIRST_WITH_NEIGHBOURS,
    FIRST_WITH_ROWS,
    LATENTS,
    NETWORKS,
    SCENE,
    Section,
    container_bytes,
    pack,
    unpack,
    version_of,
)
from compgs.codec.latents import read_head
from compgs.codec.reader import file_info, read_content, read_latents
from compgs.codec.sections import DILATION_LAYOUT, SCENE_LAYOUT, SEES_COORDINATES, decode_scene
from compgs.codec.writer import write_content
from compgs.errors import BitstreamError

GOLDEN = Path(__file__).parent.parent / "tests" / "golden"
SLOW = "long"  # a million symbols, which each forgery of it would decode
# Processor seconds that decoding a file may take: what the bounds on symbols and products let a small file ask for, and
# what they let each byte ask for (2^15 products, 128 symbols), on a slow core.
BASE_SECONDS = 4.0
SECONDS_PER_BYTE = 2e-4


def golden_paths() -> list[Path]:
    return [path for path in sorted(GOLDEN.glob("*.cgs")) if path.stem != SLOW]


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
    mixed = [theirs.get(s.number, s) if rng.random() < 0.3 else s for s in unpack(data)]
    return pack(mixed, version_of(data))


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
    return pack(sections, version_of(data))


def forged_scene(rng: np.random.Generator, data: bytes, other: bytes) -> bytes:
    """Absurd counts and dimensions in the scene section, all checksums made right again."""
    sections = unpack(data)
    i = next(i for i, section in enumerate(sections) if section.number == SCENE)
    payload = bytearray(sections[i].data)
    for _ in range(rng.integers(1, 3)):
        place = int(rng.integers(len(payload)))
        payload[place] = rng.choice([0, 1, 2, 64, 127, 128, 254, 255])
    sections[i] = Section(SCENE, bytes(payload))
    return pack(sections, version_of(data))


def forged_groups(rng: np.random.Generator, data: bytes, other: bytes) -> bytes:
    """Groups changed, exchanged, dropped or added, all checksums made right again."""
    sections = unpack(data)
    i = next(i for i, section in enumerate(sections) if section.number == SCENE)
    version = max(FIRST_WITH_NEIGHBOURS, version_of(data))
    scene = decode_scene(sections[i].data, "scene", version)
    groups = list(scene.dimensions.groups)
    at, to = (int(n) for n in rng.integers(len(groups), size=2))
    match rng.integers(7):
        case 0:
            groups[at], groups[to] = groups[to], groups[at]
        case 1 if len(groups) > 1:
            del groups[at]
        case 2:
            groups.insert(to, groups[at])
        case 3:
            groups[at] = replace(groups[at], role=Role(rng.integers(4)))
        case 4:
            groups[at] = replace(groups[at], channels=int(rng.choice([1, 2, 6, 64, 255, 256, 1 << 20])))
        case 5:
            context = tuple(j for j in range(len(groups)) if rng.random() < 0.4)
            groups[at] = replace(
                groups[at],
                context=context,
                sees_coordinates=bool(rng.integers(2)),
                sees_neighbours=bool(rng.integers(2)),
            )
        case _:
            odd = [0.0, -1.0, 1.0, float("nan"), float("inf"), 1e-30]
            groups[at] = replace(groups[at], steps=tuple(rng.choice(odd, rng.integers(0, 8))))
    fields = struct.calcsize(SCENE_LAYOUT)
    fields += struct.calcsize(DILATION_LAYOUT) if version >= FIRST_WITH_DILATION else 0
    described = b"".join(starmap(_described, enumerate(groups)))
    sections[i] = Section(SCENE, sections[i].data[:fields] + varint(len(groups)) + described)
    return pack(sections, version)


def _described(index: int, shape: GroupShape) -> bytes:
    taken = (*shape.context, index) if shape.sees_neighbours else shape.context
    context = SEES_COORDINATES * shape.sees_coordinates + sum(2 << i for i in taken)
    steps = struct.pack(f"<{len(shape.steps)}f", *shape.steps)
    return bytes([shape.role]) + varint(shape.channels) + varint(context) + varint(len(shape.steps)) + steps


def forged_range(rng: np.random.Generator, data: bytes, other: bytes) -> bytes:
    """A range with another head, left out, twice, or in another's place, all checksums made right again."""
    sections = unpack(data)
    places = [i for i, section in enumerate(sections) if section.number == LATENTS]
    i, j = (places[n] for n in rng.integers(len(places), size=2))
    match rng.integers(4):
        case 0:
            sections[i], sections[j] = sections[j], sections[i]
        case 1:
            del sections[i]
        case 2:
            sections.insert(j, sections[i])
        case _:
            reader = FieldReader(sections[i].data, "latents")
            head = read_head(reader)
            fields = [head.level, head.anchors, head.coupled]
            changed = rng.integers(3)
            fields[changed] = int(
                rng.choice([0, 1, fields[changed] + 1, 2 * fields[changed], 22, 1 << 24, 1 << 40])
            )
            payload = b"".join(map(varint, fields)) + sections[i].data[reader.position :]
            sections[i] = Section(LATENTS, payload)
    return pack(sections, version_of(data))


def forged_network(rng: np.random.Generator, data: bytes, other: bytes) -> bytes:
    """Flags, widths and inertia of networks and layers, or their number, changed; all checksums made right again."""
    sections = unpack(data)
    scene = next(decode_scene(s.data, s.name, version_of(data)) for s in sections if s.number == SCENE)
    i = next(i for i, section in enumerate(sections) if section.number == NETWORKS)
    reader = FieldReader(sections[i].data, "entropy networks")
    places = []
    for follows in scene.dimensions.networks_that_follow:
        places.append(reader.position)
        layers = reader.varint("layers", 1, 8)
        places.append(reader.position)
        reader.bytes(1, "flags")
        for _ in range(layers):
            places.append(reader.position)
            reader.varint("width", 1, 1 << 16)
            places.append(reader.position)
            reader.bytes(1, "flags")
        if follows:
            places.append(reader.position)
            reader.bytes(1, "follow shift")
        if version_of(data) >= FIRST_WITH_ROWS:
            places.append(reader.position)
            reader.bytes(1, "inertia")
    payload = bytearray(sections[i].data)
    for _ in range(rng.integers(1, 4)):
        place = int(rng.choice(places))
        payload[place] = rng.choice([payload[place] ^ 1 << rng.integers(8), 1, 2, 8, 127])
    sections[i] = Section(NETWORKS, bytes(payload))
    return pack(sections, version_of(data))


FORGERS = (
    truncated,
    flipped,
    noise,
    forged_header,
    spliced,
    forged_payload,
    forged_scene,
    forged_groups,
    forged_range,
    forged_network,
)


def forgeries(files: list[bytes], seed: int) -> Iterator[tuple[str, bytes]]:
    """Endlessly many (kind, file)."""
    rng = np.random.default_rng(seed)
    while True:
        data, other = (files[rng.integers(len(files))] for _ in range(2))
        forger = FORGERS[rng.integers(len(FORGERS))]
        yield forger.__name__, forger(rng, data, other)


def outcome(data: bytes) -> str:
    """Name of the error that the decoder raises, or "accepted"; anything unexpected propagates."""
    content = _read(data, prefix=False)
    if isinstance(content, BitstreamError):
        beginning = _read(data, prefix=True)
        if isinstance(beginning, FileContent):
            _check_written(beginning)
        return type(content).__name__
    file_info(data)
    written = _check_written(content)
    beginning = _read(data, prefix=True)
    assert isinstance(beginning, FileContent), f"accepted as a whole, not as a beginning: {beginning}"
    assert write_content(beginning) == written, "another scene as a beginning"
    return "accepted"


def _read(data: bytes, *, prefix: bool) -> FileContent | BitstreamError:
    try:
        return read_latents(data, prefix=prefix)[0]
    except BitstreamError as error:
        assert str(error), "an error without a message"
        return error


def _check_written(content: FileContent) -> bytes:
    again = write_content(content)
    assert write_content(read_content(again)) == again, "accepted, but its content does not survive writing"
    return again


def decoding_seconds(data: bytes) -> float:
    """Processor time of decoding, however it ends: of a busy machine it knows nothing."""
    start = time.process_time()
    _read(data, prefix=False)
    return time.process_time() - start


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
    paths = options.files or golden_paths()
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
        seconds = 0.0
        try:
            seconds = decoding_seconds(data)
            result = outcome(data)
        except Exception as error:  # whatever is not of the family is what we look for
            result = f"FAILURE {type(error).__name__}: {error}"
        slowest = max(slowest, seconds)
        if result.startswith("FAILURE") or seconds > BASE_SECONDS + SECONDS_PER_BYTE * len(data):
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
