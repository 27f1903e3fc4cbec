"""The page of a comparison: what two files are in numbers, and their pictures with a line between them."""

from dataclasses import dataclass

import numpy as np

from compgs.evaluation.compared_files import ComparedView, Comparison
from compgs.evaluation.reports.page import Picture, folded, heading, page, paragraph, slider
from compgs.evaluation.reports.pictures import reduced, urls_within
from compgs.evaluation.reports.tables import Column, Table, to_html

SHOWN_VIEWS = 8  # with pictures, those that differ most
WIDTH = 800  # pixels of a picture, at most
PICTURE_BYTES = 6_000_000  # of all pictures in the page, at most


class ComparisonPage:
    """Collects the pictures of the views that differ most, while they are compared."""

    def __init__(self, a: str, b: str) -> None:
        self._names = self._apart(a, b)
        self._kept: list[_Kept] = []

    def keep(self, row: ComparedView, pictures: dict[str, np.ndarray]) -> None:
        """Keep the pictures of one view: `a`, `b`, `difference` and perhaps `gt`, the photograph."""
        height, width = pictures["a"].shape[:2]
        small = {name: reduced(picture, WIDTH) for name, picture in pictures.items()}
        self._kept.append(_Kept(row, small, width, height))
        self._kept = sorted(self._kept, key=lambda kept: kept.row.psnr)[:SHOWN_VIEWS]

    def html(self, found: Comparison) -> bytes:
        """The page, of what was found in the end."""
        return page(
            f"{found.a.file} and {found.b.file}",
            "".join([*map(paragraph, found.in_words()), *self._tables(found), *self._figures(found)]),
        )

    def _tables(self, found: Comparison) -> list[str]:
        return [
            to_html(files_table(found, *self._names)),
            *(paragraph(f"Note: {note}.", "note") for note in found.notes),
        ]

    def _figures(self, found: Comparison) -> list[str]:
        left = len(found.per_view) - len(self._kept)
        parts = [heading("Pictures, those that differ most first")]
        labels = {"a": self._names[0], "b": self._names[1], "gt": "photograph"}
        images = [picture for kept in self._kept for picture in kept.pictures.values()]
        urls = iter(urls_within(images, WIDTH, PICTURE_BYTES))
        for kept in self._kept:
            url = {name: next(urls) for name in kept.pictures}
            pictures = [
                Picture(label, url[name], url["difference"] if name == "b" else None)
                for name, label in labels.items()
                if name in url
            ]
            parts.append(heading(kept.row.name, 3))
            parts.append(slider(pictures, kept.width, kept.height, view_in_words(kept.row, self._names)))
        if left:
            parts.append(paragraph(f"{left} more views are in the table below.", "note"))
        parts.append(folded("Every view in numbers", to_html(views_table(found, *self._names))))
        parts.append(folded("Bytes by component", to_html(components_table(found))))
        return parts

    @staticmethod
    def _apart(a: str, b: str) -> tuple[str, str]:
        """Names of the files, with which is which where they have one name."""
        return (a, b) if a != b else (f"{a} (A)", f"{b} (B)")


@dataclass(frozen=True, eq=False)
class _Kept:
    row: ComparedView
    pictures: dict[str, np.ndarray]  # [H, W, 3] uint8, reduced to WIDTH
    width: int  # pixels, before
    height: int


def view_in_words(row: ComparedView, names: tuple[str, str]) -> str:
    """Below the pictures of a view."""
    parts = []
    if row.a_psnr is not None and row.b_psnr is not None:
        shown = (f"{name} {_db(psnr)}" for name, psnr in zip(names, (row.a_psnr, row.b_psnr), strict=True))
        parts.append(f"Against the photograph: {', '.join(shown)}.")
    parts.append(f"Against each other: {_db(row.psnr)}, SSIM {row.ssim:.4f}.")
    if row.psnr != float("inf"):
        parts.append(
            "Beside them the difference of the two files: black is none, white "
            f"{row.difference_scale} of 255 levels or more."
        )
    return " ".join(parts)


def _db(psnr: float) -> str:
    return "identical" if psnr == float("inf") else f"{psnr:.2f} dB"


def files_table(found: Comparison, a: str, b: str) -> Table:
    """Both files, a row each, and how the second compares with the first."""
    columns = (
        Column("file", "file"),
        Column("format", "format"),
        Column("bytes", "bytes", ",.0f"),
        Column("primitives", "primitives", ",.0f"),
        Column("anchors", "anchors", ",.0f"),
        Column("psnr", "PSNR against photographs, dB", ".2f"),
        Column("ssim", "SSIM", ".4f"),
        Column("lpips", "LPIPS", ".4f"),
        Column("lpips_3dgs", "LPIPS as 3DGS", ".4f"),
        Column("decode_seconds", "decoding, s", ".3f"),
        Column("render_seconds", "a view, s", ".4f"),
    )
    rows = tuple(
        (
            name,
            f".{f.format}",
            f.bytes,
            f.primitives,
            f.anchors,
            f.psnr,
            f.ssim,
            f.lpips,
            f.lpips_3dgs,
            f.decode_seconds,
            f.render_seconds,
        )
        for name, f in ((a, found.a), (b, found.b))
    )
    where = f"Rendered on {found.device}, {found.threads} threads."
    return Table("files", "Files", columns, rows, (where,)).without_empty_columns()


def views_table(found: Comparison, a: str, b: str) -> Table:
    """All views, those that differ most first."""
    columns = (
        Column("view", "view"),
        Column("psnr", "each other, PSNR, dB", ".2f"),
        Column("ssim", "SSIM", ".4f"),
        Column("lpips", "LPIPS", ".4f"),
        Column("a_psnr", f"{a}, PSNR, dB", ".2f"),
        Column("a_ssim", "SSIM", ".4f"),
        Column("a_lpips", "LPIPS", ".4f"),
        Column("b_psnr", f"{b}, PSNR, dB", ".2f"),
        Column("b_ssim", "SSIM", ".4f"),
        Column("b_lpips", "LPIPS", ".4f"),
    )
    rows = tuple(
        tuple(getattr(view, column.key if column.key != "view" else "name") for column in columns)
        for view in sorted(found.per_view, key=lambda view: view.psnr)
    )
    return Table("views", "Views", columns, rows).without_empty_columns()


def components_table(found: Comparison) -> Table:
    """Bytes of each file by component."""
    columns = (Column("file", "file"), Column("component", "component"), Column("bytes", "bytes", ",.0f"))
    rows = tuple((f.file, name, count) for f in (found.a, found.b) for name, count in f.components.items())
    return Table("components", "Bytes by component", columns, rows)
