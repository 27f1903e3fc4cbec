"""c/compgs.h: it conforms, takes what the package takes, and reads no byte that is not its own."""

import re
import shutil
import subprocess
import sys
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from compgs.codec import (
    content,
    fields,
    format,
    integer_network,
    latents,
    rans,
    rows,
    sections,
    tables,
    weights,
)
from compgs.codec.decoder import from_latents
from compgs.codec.reader import read_latents
from compgs.errors import BitstreamError
from compgs.ordering import neighbours

ROOT = Path(__file__).parents[2]
HEADER = ROOT / "c" / "compgs.h"
PROGRAM = ROOT / "conformance" / "decoders" / "c.c"
WARNINGS = ("-Wall", "-Wextra", "-Wpedantic", "-Wshadow", "-Werror")
SANITIZERS = ("-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
sys.path += [str(ROOT / "conformance"), str(ROOT / "conformance" / "decoders"), str(ROOT / "benchmarks")]
import run  # noqa: E402
from fuzz import forgeries, golden_paths  # noqa: E402
from package import arrays  # noqa: E402


def compiled(target: Path, compiler: str, *options: str) -> subprocess.CompletedProcess:
    path = shutil.which(compiler)
    if path is None:
        pytest.skip(f"no {compiler} on PATH")
    command = [path, *options, "-I", str(HEADER.parent), "-o", str(target), str(PROGRAM), "-lm"]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built so that it stops at the first byte that it must not touch, and at the first sum that overflows."""
    target = tmp_path_factory.mktemp("c") / "cgs"
    done = compiled(target, "cc", "-std=c99", *SANITIZERS)
    if done.returncode and "cannot find" in done.stderr:
        pytest.skip("the compiler has no sanitizers")
    assert done.returncode == 0, done.stderr
    return target


def test_it_conforms(program: Path) -> None:
    judge = [sys.executable, str(ROOT / "conformance" / "run.py"), str(program)]
    done = subprocess.run(judge, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "conforms" in done.stdout, done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("compiler", "options"),
    [
        (compiler, options)
        for c, cpp in (("cc", "c++"), ("clang", "clang++"))
        for compiler, options in (
            (c, ("-std=c99", "-O2")),
            (cpp, ("-x", "c++", "-std=c++11", "-O2")),
        )
    ],
    ids=["C99", "C++", "C99, clang", "C++, clang"],
)
def test_it_compiles_without_a_warning(compiler: str, options: tuple[str, ...], tmp_path: Path) -> None:
    done = compiled(tmp_path / "cgs", compiler, *WARNINGS, *options)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_forgeries_are_refused_or_read_as_by_the_package(program: Path, tmp_path: Path) -> None:
    files = [path.read_bytes() for path in golden_paths()]
    file, folder = tmp_path / "forged.cgs", tmp_path / "arrays"
    folder.mkdir()
    accepted = 0
    with run.Decoder([str(program)], 60.0) as decoder:
        for kind, data in islice(forgeries(files, seed=3), 600):
            file.write_bytes(data)
            answer = decoder._ask(f"decode\t{file}\t{folder}")
            try:
                found = read_latents(data)
                from_latents(*found)
            except BitstreamError as error:
                # Which of two faults is named is free.
                assert answer == type(error).__name__ or "MissingDependency" in (
                    answer,
                    type(error).__name__,
                ), kind
                continue
            assert answer == "ok", (kind, answer)
            accepted += 1
            for name, array in arrays(*found).items():
                stored = np.frombuffer((folder / name).read_bytes(), "u1" if name == "mask" else "<i4")
                assert (stored == array.ravel()).all(), (kind, name)
    assert accepted > 20


def test_prefixes_of_any_length_are_taken_as_by_the_package(program: Path, tmp_path: Path) -> None:
    golden = ROOT / "tests" / "golden" / "rows.cgs"
    data = golden.read_bytes()
    sizes = [*range(0, 100, 7), *range(9_900, len(data) + 1, 37), len(data)]
    with run.Decoder([str(program)], 60.0) as decoder:
        for size in sizes:
            answer = decoder._ask(f"decode\t{golden}\t{tmp_path}\t{size}")
            try:
                read_latents(data[:size], prefix=True)
                expected = "ok"
            except BitstreamError as error:
                expected = type(error).__name__
            assert answer == expected, size


def test_it_has_fewer_than_1500_lines_of_code() -> None:
    text = re.sub(r"/\*.*?\*/", "", HEADER.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert sum(bool(line.strip()) for line in text.splitlines()) < 1500
    assert all(len(line) <= 128 for line in text.splitlines())


def test_its_constants_are_those_of_the_package() -> None:
    text = HEADER.read_text(encoding="utf-8")
    modules = (
        format, content, fields, integer_network, latents, neighbours, rans, rows, sections, tables, weights
    )  # fmt: skip
    stated = dict(re.findall(r"\bCGS__([A-Z_]+) = ([0-9x<\- ]+)[,\n]", text))
    compared = 0
    for name, value in stated.items():
        (found, *_) = [getattr(m, name) for m in modules if hasattr(m, name)] or [None]
        if found is not None:
            compared += 1
            assert eval(value) == found, name
    assert compared >= 25
    limits = re.findall(r"CGS__(\w+) = \{1 << (\d+), (?:1 << )?(\d+)\};", text)
    assert len(limits) == 5
    for name, free, _ in limits:
        assert getattr(format, f"FREE_{name}") == 1 << int(free)
