"""What a person sees: the same clear lines on a color terminal, in a UTF-8 pipe and where only ASCII can be shown."""

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from pathlib import Path

import pytest

from compgs.cli.main import main

GOLDEN_FILE = Path(__file__).parent.parent / "golden" / "tiny.cgs"
UTF8 = {"LANG": "C.UTF-8", "LC_ALL": "C.UTF-8", "PYTHONUTF8": "1", "TERM": "xterm-256color"}
ASCII = {
    "LANG": "C",
    "LC_ALL": "C",
    "PYTHONUTF8": "0",
    "PYTHONIOENCODING": "ascii",
    "PYTHONCOERCECLOCALE": "0",
}
COLORS = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


def environment(values: dict[str, str]) -> dict[str, str]:
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("LC_", "LANG", "PYTHONIO", "PYTEST"))}
    return {**kept, **values}


def in_a_pipe(*arguments: str, locale: dict[str, str]) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a process of its own."""
    done = subprocess.run(
        [sys.executable, "-m", "compgs", *arguments],
        capture_output=True,
        env=environment(locale),
        check=False,
    )
    return done.returncode, done.stdout.decode(), done.stderr.decode()


def in_a_terminal(*arguments: str, columns: int = 80) -> tuple[int, str]:
    """Exit code, and what is written to a color terminal."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    process = subprocess.Popen(
        [sys.executable, "-m", "compgs", *arguments],
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        env=environment(UTF8),
        start_new_session=True,
    )
    os.close(theirs)
    shown = b""
    while True:
        try:
            part = os.read(ours, 65536)
        except OSError:  # how a terminal whose other side is closed ends on Linux
            break
        if not part:
            break
        shown += part
    os.close(ours)
    return process.wait(), shown.decode().replace("\r\n", "\n")


def named(value: object) -> str:
    return " ".join(value) if isinstance(value, list) else ""


MISTAKES = [
    (["train", "x", "-o", "r", "--seed", "2.5"], "--seed: expected a whole number, found '2.5'"),
    (["train", "x", "-o", "r", "--steps", "1e4"], "--steps: expected a whole number, found '1e4'"),
    (["train", "x", "-o", "r", "--lmbda=abc"], "--lmbda: expected a number, found 'abc'"),
    (["render", "a.cgs"], "--output FOLDER|MP4|WEBP|GIF is missing"),
    (["render", "a.cgs", "-o"], "-o: expected a value (FOLDER|MP4|WEBP|GIF), found none"),
    (["render", "a.cgs", "-o", "out", "--up", "0", "-1"], "--up: expected 3 values (X Y Z), found 0 -1"),
    (["info"], "FILE|RUN is missing"),
]


@pytest.mark.parametrize(("arguments", "complaint"), MISTAKES, ids=named)
def test_a_mistake_is_one_clear_line(
    capsys: pytest.CaptureFixture[str], arguments: list[str], complaint: str
) -> None:
    help_line = f"compgs {arguments[0]} --help shows what it takes"
    assert main(arguments) == 2
    assert capsys.readouterr() == ("", f"error: {complaint}\n{help_line}\n")


@pytest.mark.parametrize(("arguments", "complaint"), MISTAKES[:5:4], ids=named)
def test_a_mistake_is_one_clear_line_in_a_utf8_pipe(arguments: list[str], complaint: str) -> None:
    help_line = f"compgs {arguments[0]} --help shows what it takes"
    assert in_a_pipe(*arguments, locale=UTF8) == (2, "", f"error: {complaint}\n{help_line}\n")


def test_a_size_of_photographs_that_is_none_is_one_clear_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "x", "-o", "r", "-r", "2.5"]) == 2
    assert capsys.readouterr() == ("", "error: -r: expected a whole number or auto, found '2.5'\n")


@pytest.mark.parametrize(("arguments", "complaint"), MISTAKES[:5:4], ids=named)
def test_a_mistake_is_one_clear_line_on_a_color_terminal(arguments: list[str], complaint: str) -> None:
    code, shown = in_a_terminal(*arguments)
    help_line = f"compgs {arguments[0]} --help shows what it takes"
    assert (code, COLORS.sub("", shown)) == (2, f"error: {complaint}\n{help_line}\n")


@pytest.mark.parametrize(
    ("name", "locale"),
    [
        pytest.param(b"\xc3\xbcber.cgs", ASCII, id="a name in UTF-8, ASCII"),
        pytest.param(b"caf\xe9.cgs", UTF8, id="a name that is none, UTF-8"),
        pytest.param(b"\xc3\xbcber.cgs", UTF8, id="a name in UTF-8, UTF-8", marks=pytest.mark.slow),
        pytest.param(b"caf\xe9.cgs", ASCII, id="a name that is none, ASCII", marks=pytest.mark.slow),
    ],
)
def test_any_name_can_be_shown(tmp_path: Path, locale: dict[str, str], name: bytes) -> None:
    file = tmp_path / os.fsdecode(name)
    file.write_bytes(GOLDEN_FILE.read_bytes())
    code, out, err = in_a_pipe("info", str(file), locale=locale)
    assert (code, err) == (0, "") and out.startswith(str(tmp_path))
    code, out, err = in_a_pipe("info", f"{file}.gone", locale=locale)
    assert (code, out) == (1, "") and err.endswith("there is no such file\n") and err.count("\n") == 1


@pytest.mark.parametrize("arguments", [["--help"], ["train", "--help"]], ids=" ".join)
def test_help_can_be_read_where_only_ascii_can_be_shown(arguments: list[str]) -> None:
    code, out, err = in_a_pipe(*arguments, locale=ASCII)
    assert (code, err) == (0, "")
    assert out.isascii() and "\\u" not in out and "\\x" not in out


@pytest.mark.parametrize("arguments", [["--help"], ["train", "--help"], ["info", str(GOLDEN_FILE)]])
def test_who_reads_only_the_beginning_sees_no_traceback(arguments: list[str]) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "compgs", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=environment(UTF8),
    )
    assert process.stdout is not None and process.stderr is not None
    process.stdout.close()
    assert process.stderr.read() == b""
    assert process.wait() == 1
    process.stderr.close()
