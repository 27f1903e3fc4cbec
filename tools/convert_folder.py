"""Every scene of a folder in another format, and a table of what that saved, in Markdown.

    python tools/convert_folder.py FOLDER -o OUT [--to spz] [--time 5min] [--only LIST]

FOLDER and the folders in it are searched for files of splats and .cgs files, by their first bytes; OUT gets a file of
the same name and place for each. `--to cgs` trains, for `--time` each, and needs the extra `train`; all other formats
take seconds. `--only` names a text file with one path a line, and leaves out what it does not list: the files that a
pull request changes. The table goes to standard output, all else to standard error. Ends with 1 if a file could not be
converted; the others are there. `docker/Dockerfile` has it as `compgs-convert`, `action/action.yml` calls it.
"""

import argparse
import os
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import compgs
from compgs.cli.sizes import parse_time
from compgs.errors import CompGSError

# By their names a folder's files are chosen; what they are their first bytes say.
SUFFIXES = (".ply", ".spz", ".sog", ".splat", ".ksplat", ".glb", ".cgs")
KINDS = ("cgs", "spz", "sog", "glb", "ply", "html")


@dataclass(frozen=True)
class Row:
    """One file: what it was, what it became."""

    source: Path  # inside the folder
    before: int  # bytes
    after: int | None  # bytes; None: it could not be converted
    psnr: float | None  # dB, the new file's pictures beside the old one's; None: not measured
    error: str = ""


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--to", choices=KINDS, default="spz")
    parser.add_argument("--time", default="5min", help="for each file, with --to cgs")
    parser.add_argument("--only", type=Path, help="paths, one a line")
    options = parser.parse_args(arguments)
    try:
        seconds = parse_time(options.time, "--time")
        sources = list(scenes_in(options.folder, options.output, options.only))
    except (CompGSError, OSError) as error:
        parser.error(str(error))
    rows = [converted(source, options.folder, options.output, options.to, seconds) for source in sources]
    print(table(rows, options.to))
    return int(any(row.after is None for row in rows))


def scenes_in(folder: Path, output: Path, only: Path | None) -> Iterable[Path]:
    """Files of scenes by name; neither those of OUT nor those of hidden folders. Raises OSError."""
    if not folder.is_dir():
        raise NotADirectoryError(f"{folder}: expected a folder of scenes")
    wanted = None
    if only is not None:
        wanted = {
            Path(os.path.abspath(line)) for line in only.read_text(encoding="utf-8").splitlines() if line
        }
    for path in sorted(folder.rglob("*")):
        inside = path.relative_to(folder)
        if any(part.startswith(".") for part in inside.parts) or path.suffix.lower() not in SUFFIXES:
            continue
        if not path.is_file() or path.resolve().is_relative_to(output.resolve()):
            continue
        if wanted is None or Path(os.path.abspath(path)) in wanted:
            yield path


def converted(source: Path, folder: Path, output: Path, kind: str, seconds: float) -> Row:
    """Writes the file of one scene; what is wrong with a scene is said in its row."""
    inside = source.relative_to(folder)
    # The old ending stays in the name: a.ply and a.spz are two scenes.
    target = output / inside.with_name(f"{inside.name}.{kind}")
    before = source.stat().st_size
    print(f"{inside}", file=sys.stderr, flush=True)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        if kind == "cgs":
            compressed = compgs.compress(source, target, seconds=seconds, overwrite=True, progress=False)
            psnr = compressed.results.psnr
        else:
            psnr = compgs.export(source, target, overwrite=True, progress=False).mean
    except (CompGSError, OSError) as error:
        print(f"{inside}: {error}", file=sys.stderr, flush=True)
        return Row(inside, before, None, None, str(error))
    return Row(inside, before, target.stat().st_size, psnr)


def table(rows: list[Row], kind: str) -> str:
    """Markdown: a row for each file, and one for all of them."""
    if not rows:
        return f"No scenes to convert to .{kind}."
    lines = [f"| scene | bytes | as .{kind} | of before | PSNR beside it |", "|---|---:|---:|---:|---:|"]
    for row in rows:
        if row.after is None:
            lines.append(f"| {cell(row.source)} | {row.before:,} | {cell(row.error)} | | |")
        else:
            lines.append(
                f"| {cell(row.source)} | {row.before:,} | {row.after:,} | {share(row.after, row.before)} "
                f"| {decibels(row.psnr)} |"
            )
    done = [row for row in rows if row.after is not None]
    if len(done) > 1:
        before, after = sum(row.before for row in done), sum(row.after or 0 for row in done)
        lines.append(f"| **all** | {before:,} | {after:,} | {share(after, before)} | |")
    return "\n".join(lines)


def share(after: int, before: int) -> str:
    return f"{100 * after / before:.1f} %" if before else ""


def decibels(psnr: float | None) -> str:
    if psnr is None:
        return ""
    return "the same" if psnr == float("inf") else f"{psnr:.1f} dB"


def cell(text: object) -> str:
    """Text that a table's cell can hold, whatever a file's name is."""
    return " ".join(str(text).split()).replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;")


if __name__ == "__main__":
    sys.exit(main())
