"""A contact sheet: photographs and renderings side by side, for a person to look at."""

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

CELL_WIDTH = 480  # pixels, at most; wider images are reduced
COLUMN_WIDTH = 300  # pixels, at least: a label must fit
MARGIN = 8  # pixels
TEXT = 16  # pixels, height of a label
STRIPE = 6  # pixels, width of a stripe over what does not count
INK, PAPER = (30, 30, 30), (255, 255, 255)


def contact_sheet(
    rows: Sequence[
        tuple[np.ndarray, np.ndarray, str, float]
    ],  # photograph, rendering [H, W, 3] uint8, name, PSNR in dB
    title: str,
    truth: str = "photograph",  # what stands on the left
) -> np.ndarray:  # [H', W', 3] uint8
    """One row a view: the photograph, or what stands for it, on the left, the rendering on the right, labels above."""
    font = ImageFont.load_default(TEXT)
    pairs = [(_reduced(photograph), _reduced(rendering)) for photograph, rendering, _, _ in rows]
    column = max(COLUMN_WIDTH, *(left.width for left, _ in pairs))
    label = TEXT + 2 * MARGIN
    width = 2 * column + 3 * MARGIN
    height = label + sum(label + left.height for left, _ in pairs) + MARGIN
    sheet = Image.new("RGB", (width, height), PAPER)
    draw = ImageDraw.Draw(sheet)
    draw.text((MARGIN, MARGIN), drawable(title), fill=INK, font=font)
    top = label
    for (left, right), (_, _, name, psnr) in zip(pairs, rows, strict=True):
        draw.text((MARGIN, top + MARGIN), drawable(f"{name}: {truth}"), fill=INK, font=font)
        draw.text(
            (column + 2 * MARGIN, top + MARGIN), f"decoded file, PSNR {psnr:.2f} dB", fill=INK, font=font
        )
        top += label
        sheet.paste(left, (MARGIN, top))
        sheet.paste(right, (column + 2 * MARGIN, top))
        top += left.height
    return np.asarray(sheet)


def striped(image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """[H, W, 3] uint8 with stripes over what does not count by a mask [H, W], which keeps half of its color."""
    if mask is None:
        return image
    row, column = np.indices(mask.shape)
    stripes = np.where((row + column) // STRIPE % 2, 127, 0).astype(np.uint8)
    return np.where(mask[:, :, None], image, image // 2 + stripes[:, :, None])


def drawable(text: str) -> str:
    """Names of files need not be text; what is drawn must be."""
    return text.encode("utf-8", "replace").decode()


def _reduced(image: np.ndarray) -> Image.Image:
    picture = Image.fromarray(image)
    if picture.width <= CELL_WIDTH:
        return picture
    height = max(1, round(picture.height * CELL_WIDTH / picture.width))
    return picture.resize((CELL_WIDTH, height), Image.Resampling.BOX)
