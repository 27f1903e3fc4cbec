"""Samples of every type become 8 bits by their range, or are refused; none comes out black without a word."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from compgs.errors import UnreadableImage
from compgs.scene.images import image_size, read_image

RAMP = np.linspace(0, 1, 20)[None, :].repeat(4, 0)  # [H, W]


def tiff(values: np.ndarray) -> bytes:
    """A TIFF of samples [H, W] or [H, W, 3] of any type, written by hand: uncompressed, little endian."""
    height, width = values.shape[:2]
    count = 1 if values.ndim == 2 else values.shape[2]
    kind = {"u": 1, "i": 2, "f": 3}[values.dtype.kind]
    data, bits = values.astype(values.dtype.newbyteorder("<")).tobytes(), 8 * values.dtype.itemsize
    entries = [(256, width), (257, height), (258, [bits] * count), (259, 1), (262, 1 if count == 1 else 2)]
    entries += [(273, 0), (277, count), (278, height), (279, len(data)), (339, [kind] * count)]
    end = 8 + 2 + 12 * len(entries) + 4
    directory, extra = b"", b""
    start = end + 2 * 2 * count * (count > 2)
    for tag, value in entries:
        shorts = value if isinstance(value, list) else None
        if tag == 273:
            directory += struct.pack("<HHII", tag, 4, 1, start)
        elif shorts is None:
            directory += struct.pack("<HHII", tag, 4, 1, value)
        elif count == 1:
            directory += struct.pack("<HHIHH", tag, 3, 1, shorts[0], 0)
        else:
            directory += struct.pack("<HHII", tag, 3, count, end + len(extra))
            extra += struct.pack(f"<{count}H", *shorts)
    return b"II*\0" + struct.pack("<IH", 8, len(entries)) + directory + bytes(4) + extra + data


def png_of_16_bits(values: np.ndarray) -> bytes:
    """A PNG of samples [H, W, 3] uint16."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        )

    height, width, _ = values.shape
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    header = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


def colors(gray: np.ndarray) -> np.ndarray:
    return gray[..., None].repeat(3, -1)


def read(folder: Path, content: bytes, suffix: str = "tif") -> np.ndarray:
    file = folder / f"a.{suffix}"
    file.write_bytes(content)
    return read_image(file, None)[0]


@pytest.mark.parametrize(
    "values",
    [
        RAMP.astype(np.float32),
        (RAMP * 65535).round().astype(np.uint16),
        (RAMP * 255).round().astype(np.uint8),
    ],
    ids=["floats", "16 bits", "8 bits"],
)
def test_black_is_0_and_white_is_255_whatever_the_samples_are(tmp_path: Path, values: np.ndarray) -> None:
    image = read(tmp_path, tiff(values))
    assert np.abs(image - colors(RAMP * 255)).max() <= 0.5001


def test_colors_of_16_bits_keep_their_upper_8(tmp_path: Path) -> None:
    values = (colors(RAMP) * 65535).round().astype(np.uint16)
    for content, suffix in ((tiff(values), "tif"), (png_of_16_bits(values), "png")):
        np.testing.assert_array_equal(read(tmp_path, content, suffix), values >> 8)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (RAMP.astype(np.float32) * 255, "floating-point samples from 0 to 255; expected 0 for black and 1"),
        (RAMP.astype(np.float32) - 0.5, "floating-point samples from -0.5"),
        (np.full((4, 4), np.nan, np.float32), "floating-point samples"),
        ((RAMP * 4095).astype(np.uint16), "none of them above 4095, where white is 65535"),
        ((RAMP * 255).astype(np.uint16), "none of them above 255, where white is 65535"),
        ((RAMP * 255).astype(np.uint32), "samples of 32 bits"),
        ((RAMP * 4e9).astype(np.uint32), "samples of 32 bits"),
        ((RAMP * 65535).astype(np.int32), "sign"),
        ((RAMP * 32767).astype(np.int16), "sign"),
        (RAMP.astype(np.float64), "floating-point"),
        (RAMP.astype(np.float16), "floating-point"),
        (colors(RAMP).astype(np.float32), "floating-point"),
        (colors(RAMP * 4e9).astype(np.uint32), "32-bit"),
        (colors(RAMP * 4095).astype(np.uint16), "none of them above 4095"),
    ],
)  # fmt: skip
def test_samples_of_which_white_is_not_known_are_refused_with_the_remedy(
    tmp_path: Path, values: np.ndarray, message: str
) -> None:
    with pytest.raises(
        UnreadableImage, match=rf"a\.tif: .*{message}.*convert all images to PNG or JPEG of 8 bits"
    ):
        read(tmp_path, tiff(values))


@pytest.mark.parametrize(
    ("start", "kind"),
    [
        (b"\x76\x2f\x31\x01\x02\0\0\0", "OpenEXR"),
        (b"#?RADIANCE\n", "Radiance"),
        (b"PF\n2 2\n-1\n", "float map"),
    ],
)
def test_whole_files_of_other_formats_are_named_and_not_called_damaged(
    tmp_path: Path, start: bytes, kind: str
) -> None:
    file = tmp_path / "a.png"
    file.write_bytes(start + bytes(40))
    for reading in (image_size, lambda file: read_image(file, None)):
        with pytest.raises(UnreadableImage, match=rf"a\.png: .*{kind}.* is not read; convert"):
            reading(file)


def test_images_of_a_hundred_megapixels_are_opened_without_a_warning(
    tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    file = tmp_path / "a.png"
    Image.new("1", (11_664, 8_750)).save(file)
    recwarn.clear()
    assert image_size(file) == (11_664, 8_750)
    assert not recwarn.list
