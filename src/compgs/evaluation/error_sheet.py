"""The picture of where errors are: all views together, then the worst ones: photograph, rendering, error, distance."""

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from compgs.evaluation.contact_sheet import INK, MARGIN, PAPER, TEXT, drawable
from compgs.evaluation.error_account import COLUMNS, ROWS, SCALES, ErrorAccount
from compgs.evaluation.reports.pictures import difference_picture, scale_for

CELL = 320  # pixels, width of a picture


def error_sheet(account: ErrorAccount, title: str) -> np.ndarray:  # [H', W', 3] uint8
    """White is the largest error of its picture's scale, black none; near is bright, the background black."""
    font = ImageFont.load_default(TEXT)
    scale = scale_for([kept.levels for kept in account.pictures])
    overall = scale_for([account.mean_levels])
    first = [
        (
            f"all views, white is {overall} of 255",
            difference_picture(account.mean_levels, overall),
        ),
    ]
    rows = [
        [
            (f"{kept.name}: photograph", kept.photograph),
            ("decoded file", kept.rendering),
            (f"error, white is {scale} of 255", difference_picture(kept.levels, scale)),
            ("distance, near is bright", _nearness(kept.depth)),
        ]
        for kept in account.pictures
    ]
    label = TEXT + 2 * MARGIN
    cells = [[(text, _cell(picture)) for text, picture in row] for row in (first, *rows)]
    heights = [label + max(picture.height for _, picture in row) for row in cells]
    sheet = Image.new("RGB", (4 * (CELL + MARGIN) + MARGIN, label + sum(heights) + MARGIN), PAPER)
    draw = ImageDraw.Draw(sheet)
    draw.text((MARGIN, MARGIN), drawable(title), fill=INK, font=font)
    top = label
    for row, height in zip(cells, heights, strict=True):
        for i, (text, picture) in enumerate(row):
            left = MARGIN + i * (CELL + MARGIN)
            draw.text((left, top + MARGIN), drawable(_fitting(text, font)), fill=INK, font=font)
            sheet.paste(picture, (left, top + label))
        top += height
    _draw_shares(draw, account, (MARGIN, 2 * label), cells[0][0][1].size, font)
    _draw_words(draw, account, (CELL + 3 * MARGIN, 2 * label), font)
    return np.asarray(sheet)


def _draw_shares(
    draw: ImageDraw.ImageDraw,
    account: ErrorAccount,
    corner: tuple[int, int],
    size: tuple[int, int],
    font: ImageFont.FreeTypeFont | ImageFont.ImageFont,
) -> None:
    """The share of each field, in it."""
    for i, row in enumerate(account.regions):
        for j, part in enumerate(row):
            place = (
                corner[0] + (j + 0.5) * size[0] / COLUMNS,
                corner[1] + (i + 0.5) * size[1] / ROWS,
            )
            draw.text(
                place,
                f"{100 * part.share:.0f} %",
                "white",
                font,
                anchor="mm",
                stroke_width=2,
                stroke_fill="black",
            )


def _draw_words(
    draw: ImageDraw.ImageDraw,
    account: ErrorAccount,
    corner: tuple[int, int],
    font: ImageFont.FreeTypeFont | ImageFont.ImageFont,
) -> None:
    """Scales and distances, beside the picture of all views, a column each."""
    scales = [f"{100 * p.share:3.0f} %  {scale_in_words(p.finer_than)}" for p in account.scales]
    distances = [f"{100 * p.share:3.0f} %  {distance_in_words(p.near, p.far)}" for p in account.distances]
    for i, lines in enumerate((["error by scale", *scales], ["error by distance", *distances])):
        for line, text in enumerate(lines):
            draw.text((corner[0] + i * 1.5 * CELL, corner[1] + line * (TEXT + MARGIN // 2)), text, INK, font)


def scale_in_words(finer_than: int | None) -> str:
    """Say the scale of a part of the error."""
    if finer_than is None:
        return f"{SCALES[-1]} pixels and coarser"
    at = SCALES.index(finer_than)
    return f"{SCALES[at - 1]} to {finer_than} pixels" if at else f"finer than {finer_than} pixels"


def distance_in_words(near: float | None, far: float | None) -> str:
    """Say the distance of a part of the error."""
    return "background" if near is None or far is None else f"{near:.3g} to {far:.3g}"


def _cell(picture: np.ndarray) -> Image.Image:
    height = max(1, round(picture.shape[0] * CELL / picture.shape[1]))
    return Image.fromarray(picture).resize((CELL, height), Image.Resampling.LANCZOS)


def _nearness(depth: np.ndarray) -> np.ndarray:  # [H, W, 3] uint8
    """Bright where near, by the logarithm of the distance, from the nearest to the farthest hundredth."""
    shown = np.isfinite(depth) & (depth > 0)
    level = np.zeros(depth.shape)
    if shown.any():
        logarithm = np.log(np.where(shown, depth, 1))
        near, far = np.quantile(logarithm[shown], (0.01, 0.99))
        level = np.where(shown, np.clip((far - logarithm) / max(far - near, 1e-9), 0, 1) * 0.9 + 0.1, 0)
    return np.repeat((255 * level).round().astype(np.uint8)[:, :, None], 3, 2)


def _fitting(text: str, font: ImageFont.FreeTypeFont | ImageFont.ImageFont) -> str:
    """The end of a text that is too long for a cell: names of views differ there."""
    while font.getlength(text) > CELL and len(text) > 1:
        text = "…" + text[2:]
    return text
