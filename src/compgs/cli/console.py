"""What people read: the console, tables, sizes and times."""

import io
import sys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from compgs.cli.usage import in_words_of_options
from compgs.outputs import json_text
from compgs.words import duration, size

if TYPE_CHECKING:
    from compgs.codec.reader import RangeInfo
    from compgs.evaluation.compared_files import Comparison
    from compgs.evaluation.error_account import ErrorAccount, Part, ScalePart
    from compgs.evaluation.reduction import Reduction
    from compgs.evaluation.results import Results
    from compgs.formats.tiled import TileEntry

WORST_VIEWS = 5  # that are named
COLORS_DIFFER = 0.5  # dB by which a fit of colors raises the PSNR, for one line to say so

console = Console(highlight=False, soft_wrap=True)
errors = Console(stderr=True, highlight=False, soft_wrap=True)


def show_whatever_can_be_shown() -> None:
    """Characters that the terminal or file cannot take, or that are none (in names of files), appear as `\\udce9`."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def speak(*, quiet: bool = False, results_alone: bool = False) -> None:
    """How loud what follows is: `quiet`, warnings and errors alone are said; with `results_alone` standard output is
    for results (`print_json`), and what is said goes to standard error.
    """
    console.quiet = quiet
    console.stderr = results_alone


def print_json(results: "dict[str, Any]") -> None:
    """Results for a program, on standard output."""
    print(json_text(results))


def say(message: str) -> None:
    """One line for a person, markup taken literally."""
    console.print(escape(message))


def announce(message: str) -> None:
    """One line that whoever started the command waits for, and may answer with an interrupt at once.

    It goes past rich: an interrupt that meets rich between writing and forgetting a line has it written twice.
    """
    if not console.quiet:
        print(message, file=console.file, flush=True)


def warn(message: str) -> None:
    """One line about what is probably not as somebody meant it, markup taken literally."""
    errors.print(f"[bold yellow]warning:[/] {escape(message)}")


def print_components(components: Mapping[str, int], anchors: int, coupled: int) -> None:
    """Bytes and bits by component of a .cgs file."""
    print_shares(components, {"bits/anchor": anchors, "bits/coupled": coupled})


def print_ranges(ranges: "Sequence[RangeInfo]") -> None:
    """Beginnings of a file that are scenes."""
    table = Table(box=None, pad_edge=False)
    for heading in ("octree level", "anchors up to there", "bytes of the file"):
        table.add_column(heading, justify="right")
    for part in ranges:
        table.add_row(f"{part.level}", f"{part.anchors:,}", f"{part.bytes:,}")
    console.print(table)


def print_tiles(tiles: "Sequence[TileEntry]") -> None:
    """What each tile of a scene has and takes."""
    table = Table(box=None, pad_edge=False)
    for heading in ("tile", "anchors", "coupled primitives", "bytes", "memory when open"):
        table.add_column(heading, justify="left" if heading == "tile" else "right")
    for tile in tiles:
        counts = (tile.anchors, tile.coupled_primitives, tile.bytes)
        table.add_row(tile.name, *(f"{count:,}" for count in counts), size(tile.memory))
    console.print(table)


def print_shares(components: Mapping[str, int], counts: Mapping[str, int]) -> None:
    """A table of bytes by component; each of the `counts` gets a column: bits per one of them."""
    total = sum(components.values())
    table = Table(box=None, pad_edge=False)
    for heading in ("component", "bytes", "share", *counts):
        table.add_column(heading, justify="left" if heading == "component" else "right")
    for name, count in [*components.items(), ("total", total)]:
        share = f"{100 * count / max(total, 1):.1f} %"
        bits = [f"{8 * count / max(each, 1):.2f}" for each in counts.values()]
        style = "bold" if name == "total" else None
        table.add_row(name, f"{count:,}", share, *bits, style=style)
    console.print(table)


def print_profile(milliseconds: Mapping[str, float]) -> None:
    """Where a training step's time goes."""
    table = Table(box=None, pad_edge=False)
    table.add_column("part of a step")
    table.add_column("ms", justify="right")
    table.add_column("share", justify="right")
    total = sum(milliseconds.values())
    for part, value in [*milliseconds.items(), ("total", total)]:
        style = "bold" if part == "total" else None
        table.add_row(part, f"{value:.2f}", f"{100 * value / max(total, 1e-9):.0f} %", style=style)
    console.print(table)


def quality_of(results: "Results") -> str:
    """`PSNR 26.10 dB, SSIM 0.8810 on 5 held-out views of 320 x 240 pixels`, with the measures that were asked for."""
    measures = [f"PSNR {results.psnr:.2f} dB", f"SSIM {results.ssim:.4f}"]
    measures += (
        []
        if results.lpips is None
        else [f"LPIPS {results.lpips:.4f} ({results.lpips_3dgs:.4f} as 3DGS has it)"]
    )
    measures += [] if results.flip is None else [f"FLIP {results.flip:.4f}"]
    views = f"{len(results.per_view)} held-out views of {results.width} x {results.height} pixels"
    if results.psnr_colors_fitted > results.psnr + COLORS_DIFFER:
        views += f"; PSNR, colors fitted: {results.psnr_colors_fitted:.2f} dB"
    if results.psnr_poses_aligned is not None:
        views += f"; PSNR, poses aligned: {results.psnr_poses_aligned:.2f} dB"
    return f"{', '.join(measures)} on {views}"


def say_remarks(results: "Results") -> None:
    """What is to be known beside the figures of an evaluation, if anything."""
    for note in results.notes:
        warn(in_words_of_options(note))
    if results.lpips is None and results.lpips_note != "not asked for":
        say(f"LPIPS: {results.lpips_note}")


def print_results(results: "Results") -> None:
    """The short table of an evaluation."""
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column()
    table.add_column(justify="right", style="bold")
    table.add_row("PSNR", f"{results.psnr:.2f} dB")
    table.add_row("SSIM", f"{results.ssim:.4f}")
    table.add_row("PSNR, colors fitted", f"{results.psnr_colors_fitted:.2f} dB")
    table.add_row("SSIM, colors fitted", f"{results.ssim_colors_fitted:.4f}")
    if results.psnr_poses_aligned is not None:
        table.add_row("PSNR, poses aligned", f"{results.psnr_poses_aligned:.2f} dB")
        table.add_row("SSIM, poses aligned", f"{results.ssim_poses_aligned:.4f}")
    if results.lpips is not None:
        table.add_row("LPIPS", f"{results.lpips:.4f}")
        table.add_row("LPIPS as 3DGS measures it", f"{results.lpips_3dgs:.4f}")
    if results.flip is not None:
        table.add_row("FLIP", f"{results.flip:.4f}")
    table.add_row("file", f"{results.bytes:,} bytes")
    if results.splats is not None:
        table.add_row("splats", f"{results.splats:,}")
    if results.anchors is not None:
        table.add_row("anchors", f"{results.anchors:,}")
        table.add_row("coupled primitives", f"{results.coupled_primitives:,}")
        table.add_row("bits per anchor", f"{results.bits_per_anchor:.1f}")
    table.add_row("decoding", duration(results.decode_seconds))
    table.add_row("rendering a view", duration(results.render_seconds))
    if results.degrees_to_training is not None:
        table.add_row("to the nearest training view", f"{results.degrees_to_training:.1f}°")
    views = f"{len(results.per_view)} held-out views, {results.width} x {results.height}"
    say(f"{results.file} on {results.scene}: {views}, {results.device}, {results.threads} threads")
    console.print(table)
    say_remarks(results)


def print_errors(errors: "ErrorAccount") -> None:
    """Where the error is, a table for each question."""
    from compgs.evaluation.error_sheet import distance_in_words, scale_in_words

    def db(psnr: float | None) -> str:
        return "" if psnr is None else f"{psnr:.2f} dB"

    def share(part: "Part | ScalePart") -> str:
        return f"{100 * part.share:.1f} %"

    say("Where the squared error is, by region of the picture:")
    table = Table(box=None, pad_edge=False, show_header=False)
    for row in errors.regions:
        table.add_row(*map(share, row))
    console.print(table)
    _print_parts(("scale", "of the error"), [(scale_in_words(p.finer_than), share(p)) for p in errors.scales])
    _print_parts(
        ("distance, world units", "of the error", "of the pixels", "PSNR"),
        [
            (distance_in_words(p.near, p.far), share(p), f"{100 * p.pixels:.1f} %", db(p.psnr))
            for p in errors.distances
        ],
    )
    _print_parts(
        ("view, the worst", "of the error", "PSNR"),
        [(view.name, share(view), db(view.psnr)) for view in errors.views[:WORST_VIEWS]],
    )


def _print_parts(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    console.print()
    table = Table(box=None, pad_edge=False)
    for i, heading in enumerate(headings):
        table.add_column(heading, justify="right" if i else "left")
    for cells in rows:
        table.add_row(*map(escape, cells))
    console.print(table)


def print_reduction(reduction: "Reduction") -> None:
    """What a file was, and what it lost by becoming smaller."""
    before, after = reduction.before, reduction.after
    table = Table(box=None, pad_edge=False)
    for heading in ("", "before", "after", "change"):
        table.add_column(heading, justify="left" if heading == "" else "right")
    counts: dict[str, tuple[int, int]] = {
        "bytes": (before.bytes, after.bytes),
        "anchors": (before.anchors, after.anchors),
        "coupled primitives": (before.coupled_primitives, after.coupled_primitives),
    }
    for name, (old, new) in counts.items():
        table.add_row(name, f"{old:,}", f"{new:,}", f"{100 * (new / old - 1):+.1f} %")
    if before.held_out_psnr is not None and after.held_out_psnr is not None:
        quality = (before.held_out_psnr, after.held_out_psnr)
        change = quality[1] - quality[0]
        shown = (f"{quality[0]:.2f} dB", f"{quality[1]:.2f} dB", f"{change:+.2f} dB")
        table.add_row("PSNR, held-out photographs", *shown)
    console.print(table)
    say(f"new renderings against old ones, {reduction.cameras} cameras: PSNR {reduction.psnr:.2f} dB")


def print_comparison(found: "Comparison") -> None:
    """Two files beside each other."""
    a, b = found.a, found.b
    table = Table(box=None, pad_edge=False)
    table.add_column("")
    for heading in (a.file, b.file, "change"):
        table.add_column(escape(heading), justify="right")
    for name, old, new in (
        ("bytes", a.bytes, b.bytes),
        ("primitives", a.primitives, b.primitives),
        ("anchors", a.anchors, b.anchors),
    ):
        if old is None and new is None:
            continue
        change = f"{100 * (new / old - 1):+.1f} %" if old and new is not None else ""
        table.add_row(name, *("" if count is None else f"{count:,}" for count in (old, new)), change)
    if a.psnr is not None and b.psnr is not None and a.ssim is not None and b.ssim is not None:
        change = f"{b.psnr - a.psnr:+.2f} dB"
        table.add_row("PSNR, photographs", f"{a.psnr:.2f} dB", f"{b.psnr:.2f} dB", change)
        table.add_row("SSIM, photographs", f"{a.ssim:.4f}", f"{b.ssim:.4f}", f"{b.ssim - a.ssim:+.4f}")
    for key, name in (("lpips", "LPIPS"), ("lpips_3dgs", "LPIPS as 3DGS measures it")):
        old, new = getattr(a, key), getattr(b, key)
        if old is not None and new is not None:
            table.add_row(f"{name}, photographs", f"{old:.4f}", f"{new:.4f}", f"{new - old:+.4f}")
    table.add_row("decoding", duration(a.decode_seconds), duration(b.decode_seconds))
    table.add_row("rendering a view", duration(a.render_seconds), duration(b.render_seconds))
    console.print(table)
    for line in found.in_words():
        say(line)
    for note in found.notes:
        say(f"note: {note}")
