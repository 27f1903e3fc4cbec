"""`compgs serve`: what is wrong with its arguments, and that it serves until it is stopped."""

import http.client
import re
import signal
import socket
import subprocess
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from compgs.cli.main import main


def test_a_folder_that_is_none_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve", str(tmp_path / "missing")]) == 2
    assert "expected a folder with .cgs files" in capsys.readouterr().err


def test_a_port_that_is_taken_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["serve", str(tmp_path), "--port", str(port)]) == 2
    message = capsys.readouterr().err
    assert f"--port {port}: cannot be listened at" in message and "--port 0" in message


def test_it_serves_its_folder_until_it_is_stopped(
    tmp_path: Path, serving: Callable[..., AbstractContextManager[subprocess.Popen[str]]]
) -> None:
    (tmp_path / "scene.cgs").write_bytes(b"bytes")
    with serving("serve", str(tmp_path)) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        found = re.fullmatch(r"1 file: http://127\.0\.0\.1:(\d+)/\n", line)
        assert found is not None, line
        connection = http.client.HTTPConnection("127.0.0.1", int(found[1]), timeout=30)
        connection.request("GET", "/files/scene.cgs")
        assert connection.getresponse().read() == b"bytes"
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0


def test_an_interrupt_right_after_its_address_ends_it_as_well(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(text: str) -> None:
        raise KeyboardInterrupt(text)

    monkeypatch.setattr("compgs.cli.serve.announce", interrupted)
    assert main(["serve", str(tmp_path), "--port", "0"]) == 0
    assert capsys.readouterr().out == "ended\n"
