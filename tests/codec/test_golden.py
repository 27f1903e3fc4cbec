"""Golden files: the bytes, the symbols and the latents of this version of the format, for ever."""

import hashlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from compgs.codec.reader import read_latents
from compgs.codec.writer import write_content

ROOT = Path(__file__).parents[2]
GOLDEN = ROOT / "tests" / "golden"
PINNED = json.loads((GOLDEN / "hashes.json").read_text(encoding="utf-8"))
sys.path.append(str(ROOT / "tools"))
from make_golden_files import hashes  # noqa: E402


@pytest.mark.parametrize("name", sorted(PINNED))
def test_golden_files_decode_to_the_pinned_symbols_and_latents(name: str) -> None:
    data = (GOLDEN / f"{name}.cgs").read_bytes()
    pinned = dict(PINNED[name])
    assert hashlib.sha256(data).hexdigest() == pinned.pop("file")
    content, latents = read_latents(data)
    assert hashes(content, latents) == pinned
    assert write_content(content) == data


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
