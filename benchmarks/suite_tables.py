"""Tables of all methods of a suite beside the default preset, from the tables that `compgs benchmark` wrote.

    python benchmarks/suite_tables.py out/scene_plush.csv out/scene_fox.csv

Markdown, one table a scene. "To ours" are bytes beside those in which the default preset has the same quality, read off
its curve: straight lines over the logarithm of the bytes, without points that a smaller file beats.
"""

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from compgs.evaluation.reports.summary import front

OURS = "compgs default"
HEAD = """| method | rate | PSNR, dB | SSIM | bytes | 3DGS / bytes | to ours, by PSNR | by SSIM |
|---|---|---:|---:|---:|---:|---:|---:|"""

Row = dict[str, str]
Curve = list[tuple[float, float]]  # bytes, quality: both rise


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tables", type=Path, nargs="+")
    for path in parser.parse_args().tables:
        with path.open(newline="") as file:
            rows = [row for row in csv.DictReader(file) if not row["method"].endswith("(published)")]
        title = path.stem.partition("_")[2] or path.stem
        print(f"## {title}\n\n{table(rows)}\n")


def table(rows: Sequence[Row]) -> str:
    """Markdown of the rows of a scene."""
    curves = {measure: our_curve(rows, measure) for measure in ("psnr", "ssim")}
    lines = [HEAD]
    for row in rows:
        beside = ["", ""]
        if row["method"] != OURS and curves["psnr"]:
            beside = [times(curve, int(row["bytes"]), float(row[m])) for m, curve in curves.items()]
        quality = f"{float(row['psnr']):.2f} | {float(row['ssim']):.4f}"
        size = f"{int(row['bytes']):,} | {float(row['ratio']):.1f}"
        rate = row["rate"].strip() or "–"
        lines.append(f"| {row['method']} | {rate} | {quality} | {size} | {beside[0]} | {beside[1]} |")
    return "\n".join(lines)


def our_curve(rows: Sequence[Row], measure: str) -> Curve:
    """The points of the default preset that no smaller file beats."""
    return front([(int(row["bytes"]), float(row[measure])) for row in rows if row["method"] == OURS])


def times(curve: Curve, size: int, quality: float) -> str:
    """How many times the bytes of the curve a file of so many bytes has at this quality."""
    if quality > curve[-1][1]:
        return "above"
    if quality < curve[0][1]:
        return "below"
    sizes, qualities = np.array(curve).T
    factor = size / np.exp(np.interp(quality, qualities, np.log(sizes)))
    return f"{factor:.1f}" if factor < 9.95 else f"{factor:.0f}"


if __name__ == "__main__":
    main()
