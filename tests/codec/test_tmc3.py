"""The G-PCC backend: plumbing, with a stand-in that speaks tmc3's command line; the real program if any."""

import os
import shutil
import stat
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from compgs.codec.reader import file_info, read_content
from compgs.codec.tmc3 import (
    ASKED_BY,
    ENCODER_OPTIONS,
    decode_positions_tmc3,
    encode_positions_tmc3,
    find_program,
)
from compgs.codec.writer import write_content
from compgs.errors import CorruptSection, MissingDependency, NotEncodable
from compgs.ordering.order import canonical_order

# Stores the points as they are, but backwards: TMC13 has an order of its own.
STAND_IN = """#!{python}
import struct, sys
options = dict(a.lstrip("-").split("=", 1) for a in sys.argv[1:])
if {fail!r}:
    print("Error: {fail}", file=sys.stderr)
    sys.exit(3)
stream = options["compressedStreamPath"]
if options["mode"] == "0":
    data = open(options["uncompressedDataPath"], "rb").read()
    head, body = data.split(b"end_header\\n")
    count = int(head.split(b"element vertex ")[1].split()[0])
    points = list(struct.iter_unpack("<3f", body))
    assert len(points) == count and b"format binary_little_endian 1.0" in head
    assert all(v == int(v) and v >= 0 for p in points for v in p)
    with open(stream, "wb") as f:
        for p in reversed(points):
            f.write(struct.pack("<3i", *map(int, p)))
else:
    points = list(struct.iter_unpack("<3i", open(stream, "rb").read()))
    with open(options["reconstructedDataPath"], "wb") as f:
        if {form!r} == "ascii":
            f.write(b"ply\\nformat ascii 1.0\\nelement vertex %d\\n" % len(points))
            f.write(b"property float x\\nproperty float y\\nproperty float z\\n")
            f.write(b"element face 0\\nproperty list uint8 int32 vertex_index\\nend_header\\n")
            for p in points:
                f.write(b"%d %d %d\\n" % p)
        else:
            f.write(b"ply\\nformat binary_little_endian 1.0\\nelement vertex %d\\n" % len(points))
            f.write(b"property double x\\nproperty double y\\nproperty double z\\n")
            f.write(b"property uint16 refc\\nend_header\\n")
            for p in points:
                f.write(struct.pack("<3dH", *p, 9))
"""


def install(
    monkeypatch: pytest.MonkeyPatch,
    folder: Path,
    form: str = "binary",
    fail: str = "",
    text: str | None = None,
) -> None:
    program = folder / "tmc3"
    program.write_text(text or STAND_IN.format(python=sys.executable, form=form, fail=fail))
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv(ASKED_BY, "1")
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")


def cloud(count: int = 50) -> NDArray[np.int32]:
    points = np.random.default_rng(0).integers(-500, 1 << 20, (count, 3)).astype(np.int32)
    return np.unique(points, axis=0)


@pytest.mark.parametrize("form", ["ascii", "binary"])
def test_positions_come_back_in_canonical_order(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, form: str
) -> None:
    install(monkeypatch, tmp_path, form)
    points = cloud()
    data = encode_positions_tmc3(points[::-1])
    back = decode_positions_tmc3(data, len(points))
    assert back.dtype == np.int32
    assert (back == points[canonical_order(points)]).all()


def test_the_encoder_is_asked_for_a_lossless_octree() -> None:
    assert {"--mode=0", "--positionQuantizationScale=1", "--mergeDuplicatedPoints=0"} <= set(ENCODER_OPTIONS)


def test_without_the_program_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv(ASKED_BY, "1")
    with pytest.raises(MissingDependency, match=r"tmc3.*PATH"):
        encode_positions_tmc3(cloud())
    with pytest.raises(MissingDependency, match="octree coder"):
        decode_positions_tmc3(bytes(100), 8)


@pytest.mark.parametrize("value", [None, "", "0"])
def test_no_file_makes_the_program_run_unless_somebody_asked_for_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, value: str | None
) -> None:
    trace = tmp_path / "ran"
    install(monkeypatch, tmp_path, text=f"#!/bin/sh\ntouch {trace}\n")
    if value is None:
        monkeypatch.delenv(ASKED_BY)
    else:
        monkeypatch.setenv(ASKED_BY, value)
    with pytest.raises(MissingDependency, match=r"only when .* asked for: give --tmc3, or set COMPGS_TMC3=1"):
        decode_positions_tmc3(bytes(100), 8)
    assert not trace.exists()


def test_a_failing_program_is_quoted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    install(monkeypatch, tmp_path, fail="no memory left")
    with pytest.raises(NotEncodable, match="exit status 3, Error: no memory left"):
        encode_positions_tmc3(cloud())
    with pytest.raises(CorruptSection, match="no memory left"):
        decode_positions_tmc3(bytes(100), 8)


def test_a_program_that_is_something_else_is_noticed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    install(monkeypatch, tmp_path, text="#!/bin/sh\nexit 0\n")
    with pytest.raises(NotEncodable, match="wrote no bitstream"):
        encode_positions_tmc3(cloud())
    with pytest.raises(CorruptSection, match="decoded nothing"):
        decode_positions_tmc3(bytes(100), 8)


def test_another_number_of_points_than_promised_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    install(monkeypatch, tmp_path)
    points = cloud()
    data = encode_positions_tmc3(points)
    for count in (len(points) - 1, len(points) + 1, 0):
        with pytest.raises(CorruptSection, match="anchor positions"):
            decode_positions_tmc3(data, count)
    with pytest.raises(CorruptSection):
        decode_positions_tmc3(data[:10], 1)


def test_decoded_duplicates_are_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    install(monkeypatch, tmp_path)
    with pytest.raises(CorruptSection, match="duplicates"):
        decode_positions_tmc3(bytes(12 + 24), 2)


def test_duplicates_are_refused_before_the_program_runs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    install(monkeypatch, tmp_path, fail="must not run")
    with pytest.raises(NotEncodable, match="duplicates"):
        encode_positions_tmc3(np.zeros((2, 3), np.int32))


def test_a_file_with_g_pcc_positions_holds_the_same_scene(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    golden = sorted((Path(__file__).parents[1] / "golden").glob("*.cgs"))[0].read_bytes()
    content = read_content(golden)
    with pytest.raises(MissingDependency, match="tmc3"):
        monkeypatch.setenv("PATH", str(tmp_path))
        write_content(content, "tmc3")
    monkeypatch.undo()
    install(monkeypatch, tmp_path)
    data = write_content(content, "tmc3")
    assert "positions (G-PCC)" in {section.name for section in file_info(data).sections}
    assert write_content(read_content(data)) == golden


@pytest.mark.skipif(shutil.which("tmc3") is None, reason="tmc3 (TMC13) is not on PATH")
def test_real_g_pcc_is_lossless(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(ASKED_BY, "1")
    points = cloud(3000)
    data = encode_positions_tmc3(points)
    assert (decode_positions_tmc3(data, len(points)) == points[canonical_order(points)]).all()


def test_a_program_in_the_current_folder_is_not_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Windows finds it there before it looks at PATH."""
    folder = tmp_path / "bin"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.setattr("shutil.which", lambda name: f".{os.sep}{name}")
    with pytest.raises(MissingDependency, match=r"tmc3.*PATH"):
        find_program()
    monkeypatch.setattr("shutil.which", lambda name: str(folder / name))
    assert find_program() == str(folder / "tmc3")
