"""Golden files: the bytes, the symbols and the latents of this version of the format, for ever."""

import hashlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from compgs.codec.content import Role
from compgs.codec.format import MAX_SYMBOL, VIEWPOINTS, unpack
from compgs.codec.integer_network import IntegerNetwork
from compgs.codec.rans import CHUNK_SYMBOLS, SINGLE_STATE_SYMBOLS
from compgs.codec.reader import file_info, read_latents
from compgs.codec.writer import write_content

ROOT = Path(__file__).parents[2]
GOLDEN = ROOT / "tests" / "golden"
PREFIXES = json.loads((GOLDEN / "prefixes.json").read_text(encoding="utf-8"))
PINNED = json.loads((GOLDEN / "hashes.json").read_text(encoding="utf-8"))
sys.path.append(str(ROOT / "tools"))
from describe_file import table  # noqa: E402
from make_golden_files import FOREIGN, contents, hashes  # noqa: E402


@pytest.mark.parametrize("name", sorted(PINNED))
def test_golden_files_decode_to_the_pinned_symbols_and_latents(name: str) -> None:
    data = (GOLDEN / f"{name}.cgs").read_bytes()
    pinned = dict(PINNED[name])
    assert hashlib.sha256(data).hexdigest() == pinned.pop("file")
    content, latents = read_latents(data)
    assert hashes(content, latents) == pinned
    levels = [part.level for part in file_info(data).ranges]
    if data[4] == 4 or name in FOREIGN:  # written as version 5; chosen by another encoder
        again, _ = read_latents(write_content(content, levels=levels))
        assert hashes(again, latents) == pinned and again.angular_dilation == content.angular_dilation
        return
    again = unpack(write_content(content, levels=levels))
    # Viewpoints are rounded to a box around them, which other rounded ones need not have.
    for mine, theirs in zip(again, unpack(data), strict=True):
        assert mine == theirs or mine.number == theirs.number == VIEWPOINTS


@pytest.mark.parametrize("name", sorted(PREFIXES))
def test_beginnings_of_golden_files_decode_to_the_pinned_symbols_and_latents(name: str) -> None:
    data = (GOLDEN / f"{name}.cgs").read_bytes()
    anchors = 0
    for size, pinned in PREFIXES[name].items():
        content, latents = read_latents(data[: int(size)], prefix=True)
        assert hashes(content, latents) == pinned
        assert anchors <= len(content.coordinates)
        anchors = len(content.coordinates)
    assert anchors < file_info(data).anchors


def test_a_golden_file_has_two_chunks_the_first_of_which_ends_amid_a_row() -> None:
    content = read_latents((GOLDEN / "long.cgs").read_bytes())[0]
    rows = content.groups[0].symbols
    assert SINGLE_STATE_SYMBOLS < CHUNK_SYMBOLS < rows.size < CHUNK_SYMBOLS + SINGLE_STATE_SYMBOLS
    at = CHUNK_SYMBOLS % rows.shape[1]
    assert at > 0 and rows[CHUNK_SYMBOLS // rows.shape[1], :at].any()


def test_the_golden_files_are_those_that_the_tool_makes() -> None:
    for name, (content, levels) in contents().items():
        assert write_content(content, levels=levels) == (GOLDEN / f"{name}.cgs").read_bytes(), name


def test_golden_files_show_what_the_format_has() -> None:
    """Between them: every role with a network and with tables; several groups of a role; coordinates and neighbours as
    context, with latents and alone; residual blocks, linear layers and skips; one step a group and one a channel;
    several ranges and one; both layouts of the heads, and residual embeddings there; extreme symbols; a moved origin;
    an angular dilation and none; rows with a chain, with inertia, with both.
    """
    features: set[object] = set()
    for name in PINNED:
        data = (GOLDEN / f"{name}.cgs").read_bytes()
        content = read_latents(data)[0]
        features.add(("version", file_info(data).version))
        features.add(("dilation", content.angular_dilation is not None))
        features |= {content.heads_layout, ("ranges", len(file_info(data).ranges))}
        features |= {("moved", any(content.world_offset)), *(name for name, _ in content.heads)}
        for role in Role:
            features.add((role, "groups", sum(g.shape.role == role for g in content.groups)))
        for group in content.groups:
            shape = group.shape
            features.add((shape.role, "network" if shape.has_network else "tables"))
            features.add(("coordinates", shape.sees_coordinates, bool(shape.context)))
            features.add(("neighbours", shape.sees_neighbours, bool(shape.context)))
            features.add(("steps", min(len(shape.steps), 2), shape.channels > 1))
            features |= {("symbol", int(group.symbols.min())), ("symbol", int(group.symbols.max()))}
            if isinstance(group.prior, IntegerNetwork):
                features.add(("layers", len(group.prior.layers), group.prior.skip))
                rows = group.prior.rows
                features.add(("rows", shape.role, rows.chain is not None, rows.inertia > 0))
    expected: set[object] = {"paired", "separate", "shallow", "residuals", ("ranges", 1), ("ranges", 3)}
    expected |= {("moved", True), ("moved", False), ("symbol", MAX_SYMBOL), ("symbol", -MAX_SYMBOL)}
    expected |= {(role, kind) for role in Role for kind in ("network", "tables")}
    several = {Role.SIDE: 2, Role.REFERENCE: 3, Role.LOG_SCALES: 2, Role.RESIDUAL: 2}
    expected |= {(role, "groups", count) for role, count in several.items()} | {(Role.RESIDUAL, "groups", 0)}
    expected |= {("coordinates", True, True), ("coordinates", True, False), ("coordinates", False, True)}
    expected |= {("neighbours", True, True), ("neighbours", True, False), ("version", 2), ("version", 3)}
    expected |= {("version", 4), ("version", 5), ("dilation", True), ("dilation", False)}
    expected |= {("rows", role, True, True) for role in (Role.REFERENCE, Role.LOG_SCALES, Role.RESIDUAL)}
    expected |= {("rows", Role.RESIDUAL, False, True), ("rows", Role.REFERENCE, False, False)}
    expected |= {("steps", 1, True), ("steps", 2, True)}
    expected |= {("layers", 1, False), ("layers", 4, True), ("layers", 6, True)}
    assert expected <= features


def test_another_process_with_one_thread_decodes_the_same() -> None:
    code = (
        "import json, sys; sys.path.append(sys.argv[2]); from make_golden_files import hashes; "
        "from compgs.codec.reader import read_latents; "
        "print(json.dumps(hashes(*read_latents(open(sys.argv[1], 'rb').read()))))"
    )
    for threads in ("1", "2"):
        result = subprocess.run(
            [sys.executable, "-c", code, str(GOLDEN / "default.cgs"), str(ROOT / "tools")],
            env=_environment(threads),
            capture_output=True,
            text=True,
            check=False,
        )
        assert result.returncode == 0, result.stderr
        pinned = {k: v for k, v in PINNED["default"].items() if k != "file"}
        assert json.loads(result.stdout) == pinned


def _environment(threads: str) -> dict[str, str]:
    return os.environ | {
        "NUMBA_NUM_THREADS": threads,
        "OMP_NUM_THREADS": threads,
        "OPENBLAS_NUM_THREADS": threads,
    }


def test_the_document_shows_the_tiny_file_byte_by_byte() -> None:
    data = (GOLDEN / "tiny.cgs").read_bytes()
    text = (ROOT / "docs" / "bitstream.md").read_text(encoding="utf-8").split("## A file, byte by byte")[1]
    rows = re.findall(r"^\| (\d+) \| `([0-9a-f ]*)` \|", text, re.MULTILINE)
    shown = b""
    for offset, piece in rows:
        assert int(offset) == len(shown)
        shown += bytes.fromhex(piece)
    assert shown == data


@pytest.mark.parametrize("name", sorted(PINNED.keys() - {"long"}))  # too large to be shown byte by byte
def test_every_byte_of_a_golden_file_has_a_meaning(name: str) -> None:
    data = (GOLDEN / f"{name}.cgs").read_bytes()
    shown = b""
    for offset, piece, meaning in re.findall(
        r"^\| (\d+) \| `([0-9a-f ]+)` \| (.+) \|$", table(data), re.MULTILINE
    ):
        assert int(offset) == len(shown) and meaning
        shown += bytes.fromhex(piece)
    assert shown == data
