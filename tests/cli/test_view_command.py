"""`compgs view`: what is wrong with its arguments, and that it serves until it is stopped."""

import http.client
import re
import signal
import socket
import subprocess
import sys
import webbrowser
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from compgs.cli.main import main

pytest.importorskip("viser")


def test_a_port_that_is_taken_is_named(tiny_cgs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["view", str(tiny_cgs), "--port", str(port)]) == 2
    message = capsys.readouterr().err
    assert f"--host 127.0.0.1 --port {port}: cannot be listened at" in message and "--port 0" in message


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--port", "70000"], "--port 70000: expected 0 to 65535"),
        (["--background", "0", "0", "2"], "--background (0.0, 0.0, 2.0): expected three numbers from 0 to 1"),
    ],
)
def test_values_out_of_range_are_named(
    tiny_cgs: Path, capsys: pytest.CaptureFixture[str], options: list[str], complaint: str
) -> None:
    assert main(["view", str(tiny_cgs), *options]) == 2
    assert complaint in capsys.readouterr().err


def test_without_viser_the_install_line_is_said_before_anything_is_read(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["view", "nowhere.cgs"]) == 1
    assert "the viewer needs viser: pip install '.[view]' in the project's folder" in capsys.readouterr().err


def test_a_damaged_file_is_one_clear_line(tiny_cgs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tiny_cgs.write_bytes(tiny_cgs.read_bytes()[:-9])
    assert main(["view", str(tiny_cgs)]) == 1
    assert capsys.readouterr().err.endswith("; download or copy the file again\n")


def test_it_serves_a_page_until_it_is_stopped_and_says_no_more_than_where(
    tiny_cgs: Path, serving: Callable[..., AbstractContextManager[subprocess.Popen[str]]]
) -> None:
    with serving("view", str(tiny_cgs)) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        found = re.fullmatch(r".*tiny\.cgs: http://127\.0\.0\.1:(\d+)/\n", line)
        assert found is not None, line
        connection = http.client.HTTPConnection("127.0.0.1", int(found[1]), timeout=30)
        connection.request("GET", "/")
        answer = connection.getresponse()
        assert answer.status == 200 and b"<html" in answer.read()[:2000].lower()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=30)
        assert (process.returncode, out, err) == (0, "ended\n", "")


def test_an_interrupt_right_after_its_address_ends_it_as_well(
    tiny_cgs: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(address: str) -> bool:
        raise KeyboardInterrupt(address)

    monkeypatch.setattr(webbrowser, "open", interrupted)
    assert main(["view", str(tiny_cgs), "--port", "0", "--open"]) == 0
    assert capsys.readouterr().out.endswith("ended\n")
