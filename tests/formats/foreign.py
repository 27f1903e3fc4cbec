"""Files as other programs write them, made from known numbers by their layouts alone."""

import base64
import io
import json
import struct
import zipfile
from typing import Any

import numpy as np
from PIL import Image

from compgs.formats.arrays import harmonics_above_dc


def text_ply(binary: bytes, *, end: str = "\n") -> bytes:
    """The rows of a binary file, which another test pins to the layout, in decimal digits."""
    header, _, body = binary.partition(b"end_header\n")
    names = [line.split()[2].decode() for line in header.splitlines() if line.startswith(b"property")]
    rows = np.frombuffer(body, "<f4").reshape(-1, len(names))
    lines = [*header.decode().replace("binary_little_endian", "ascii").splitlines(), "end_header"]
    lines += [" ".join(repr(float(x)) for x in row) for row in rows]
    return (end.join(lines) + end).encode()


RANGES = [f"{end}_{kind}{axis}" for kind in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
COLORS = [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]


class CompressedPly:
    """A file with random content, and what it means."""

    def __init__(self, count: int, degree: int = 0, *, colors: bool = True, seed: int = 0) -> None:
        chance = np.random.default_rng(seed)
        chunks = -(-count // 256)
        names = [*RANGES, *(COLORS if colors else [])]
        low_high = {name: chance.normal() + (3 if name.startswith("max") else 0) for name in names}
        self.chunks = [
            {name: float(np.float32(value + i)) for name, value in low_high.items()} for i in range(chunks)
        ]
        self.words = chance.integers(0, 1 << 32, (count, 4), np.uint32)
        self.harmonics = chance.integers(0, 256, (count, 3 * ((degree + 1) ** 2 - 1)), np.uint8)
        self.harmonics[:2] = np.arange(self.harmonics.shape[1]) % 2 * 255  # both ends
        self.names, self.colors = names, colors

    def content(self) -> bytes:
        count = len(self.words)
        lines = ["ply", "format binary_little_endian 1.0", "comment made by a test"]
        lines += [f"element chunk {len(self.chunks)}", *(f"property float {name}" for name in self.names)]
        lines += [f"element vertex {count}", *(f"property uint {name}" for name in PACKED)]
        if self.harmonics.shape[1]:
            lines += [f"element sh {count}"]
            lines += [f"property uchar f_rest_{i}" for i in range(self.harmonics.shape[1])]
        ranges = b"".join(struct.pack(f"<{len(self.names)}f", *chunk.values()) for chunk in self.chunks)
        body = ranges + self.words.astype("<u4").tobytes() + self.harmonics.tobytes()
        return ("\n".join([*lines, "end_header"]) + "\n").encode() + body

    def splat(self, index: int) -> dict[str, list[float]]:
        """What a splat is, in Python's numbers."""
        chunk = self.chunks[index // 256]
        position, rotation, scale, color = (int(word) for word in self.words[index])

        def between(what: str, part: float) -> float:
            return chunk[f"min_{what}"] * (1 - part) + chunk[f"max_{what}"] * part

        def three(word: int) -> list[float]:
            return [(word >> 21) / 2047, (word >> 11 & 1023) / 1023, (word & 2047) / 2047]

        others = [((rotation >> shift & 1023) / 1023 - 0.5) * 2**0.5 for shift in (20, 10, 0)]
        largest = max(0.0, 1 - sum(x * x for x in others)) ** 0.5
        others.insert(rotation >> 30, largest)
        parts = [(color >> shift & 255) / 255 for shift in (24, 16, 8, 0)]
        shown = [between(c, x) if self.colors else x for c, x in zip("rgb", parts[:3], strict=True)]
        return {
            "means": [between(axis, x) for axis, x in zip("xyz", three(position), strict=True)],
            "log_scales": [between(f"scale_{axis}", x) for axis, x in zip("xyz", three(scale), strict=True)],
            "quaternions": others,
            "opacities": [parts[3]],
            "dc": [(x - 0.5) / (0.25 / np.pi) ** 0.5 for x in shown],
            "rest": [
                {0: -4.0, 255: 4.0}.get(int(v), (int(v) + 0.5) / 256 * 8 - 4) for v in self.harmonics[index]
            ],
        }


Section = tuple[int, int, list[int]]  # degree, splats in a full bucket, and in each bucket
KSPLAT_SECTIONS: list[Section] = [(2, 4, [4, 4, 3, 1]), (1, 3, [2]), (2, 2, [2, 2])]
BUCKET_SIDE, STEPS = 5.0, 32767


def ksplat_numbers(count: int, seed: int) -> dict[str, np.ndarray]:
    chance = np.random.default_rng(seed)
    return {
        "center": chance.normal(size=(count, 3)) * 3,
        "steps": chance.integers(0, 65536, (count, 3)),
        "scales": chance.uniform(0.001, 2, (count, 3)),
        "rotation": chance.normal(size=(count, 4)),
        "color": chance.integers(0, 256, (count, 4)),
        "harmonics": chance.uniform(-1, 1, (count, 24)),
    }


def ksplat_file(
    level: int, sections: list[Section] = KSPLAT_SECTIONS, *, low: float = -2.0, high: float = 1.0
) -> bytes:
    total = sum(sum(buckets) for _, _, buckets in sections)
    header = struct.pack(
        "<BBxxIIIIHxx3f", 0, 1, len(sections) + 1, len(sections), total, total, level, 9, 9, 9
    )
    header = (header + struct.pack("<ff", low, high)).ljust(4096, b"\0")
    headers, bodies = b"", b""
    for i, (degree, full_size, buckets) in enumerate(sections):
        count, full = sum(buckets), sum(size == full_size for size in buckets)
        known = ksplat_numbers(count, i)
        splats = b""
        for j in range(count):
            if level:
                splats += struct.pack("<3H", *known["steps"][j])
                splats += struct.pack("<3e4e", *known["scales"][j], *known["rotation"][j])
            else:
                splats += struct.pack(
                    "<3f3f4f", *known["center"][j], *known["scales"][j], *known["rotation"][j]
                )
            splats += struct.pack("<4B", *known["color"][j])
            held = known["harmonics"][j, : 3 * ((degree + 1) ** 2 - 1)]
            if level == 2:
                splats += bytes(int((x - low) / (high - low) * 255) for x in held)
            else:
                splats += struct.pack(f"<{len(held)}{'e' if level else 'f'}", *held)
        if level:
            bodies += struct.pack(f"<{len(buckets) - full}I", *buckets[full:])
            bodies += struct.pack(f"<{3 * len(buckets)}f", *known["center"][: len(buckets)].ravel())
        bodies += splats
        bucket = (
            (full_size, len(buckets), BUCKET_SIDE, 12, STEPS, len(splats)) if level else (0, 0, 0.0, 0, 0, 0)
        )
        others = (full, len(buckets) - full) if level else (0, 0)
        headers += struct.pack("<IIIIfHxxIIIIH", count, count, *bucket, *others, degree).ljust(1024, b"\0")
    return header + headers.ljust(1024 * (len(sections) + 1), b"\0") + bodies


def glb_parts(glb: bytes) -> tuple[dict[str, Any], bytes]:
    """The JSON of a .glb file, and its columns."""
    length = struct.unpack_from("<I", glb, 12)[0]
    return json.loads(glb[20 : 20 + length]), glb[28 + length :]


def gltf_file(glb: bytes, uri: str | None = None) -> bytes:
    """The same as text: columns in a file of that name, or within."""
    gltf, data = glb_parts(glb)
    gltf["buffers"][0]["uri"] = (
        uri or "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    )
    return json.dumps(gltf, indent=2).encode()


SOG_COUNT, PALETTE_ROWS = 3, 2


def webp(pixels: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)).save(buffer, "WEBP", lossless=True, exact=True)
    return buffer.getvalue()


def sog_first_bytes(degree: int) -> dict[str, np.ndarray]:
    """Bytes of every image."""
    chance = np.random.default_rng(degree)
    pixels = {name: chance.integers(0, 256, (1, SOG_COUNT, 3)) for name in ("low", "high", "scales")}
    pixels["colors"] = chance.integers(0, 256, (1, SOG_COUNT, 4))
    pixels["rotations"] = np.array([[[128, 128, 255, 253], [0, 128, 128, 252], [90, 100, 110, 255]]])
    pixels["palette"] = chance.integers(0, 256, (PALETTE_ROWS, 64 * harmonics_above_dc(degree), 3))
    pixels["labels"] = np.array(
        [[[64, 0, 0], [127, 0, 0], [3, 0, 0]]]
    )  # 0, 63 of the second row; 3 of the first
    return pixels


def sog_first_files(degree: int) -> dict[str, bytes]:
    pixels = sog_first_bytes(degree)
    meta: dict[str, Any] = {
        "means": {"shape": [SOG_COUNT, 3], "mins": [-1, 0, -2], "maxs": [1, 2, 0], "files": ["low.webp", "high.webp"]},
        "scales": {"shape": [SOG_COUNT, 3], "mins": [-5, -4, -3], "maxs": [-1, -2, -3], "files": ["scales.webp"]},
        "quats": {"shape": [SOG_COUNT, 4], "encoding": "quaternion_packed", "files": ["rotations.webp"]},
        "sh0": {"shape": [SOG_COUNT, 1, 4], "mins": [-2, -1, 0, -8], "maxs": [2, 1, 1, 6], "files": ["colors.webp"]},
    }  # fmt: skip
    if degree:
        names = ["palette.webp", "labels.webp"]
        meta["shN"] = {"mins": -0.5, "maxs": 1.0, "quantization": 8, "files": names}
    images = {f"{name}.webp": webp(array) for name, array in pixels.items() if array.size}
    return {"meta.json": json.dumps(meta).encode(), **images}


def zipped(files: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return buffer.getvalue()
