"""What the tests of web/ need that is not Python: Node with the packages of web/. Skipped without."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

WEB = Path(__file__).parents[2] / "web"
MAX_SECONDS = 600


@pytest.fixture(scope="session")
def node() -> str:
    path = shutil.which("node")
    if path is None:
        pytest.skip("node (20 or later) is not on PATH")
    if not (WEB / "node_modules").is_dir():
        pytest.skip("the packages of web/ are not installed: run make web")
    return path


@pytest.fixture(scope="session")
def built(node: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """web/, built into a new folder."""
    folder = tmp_path_factory.mktemp("web")
    run([node, "build.mjs", str(folder)])
    return folder


def run(command: list[str], **environment: str) -> str:
    """Output of a program that works in web/; its output is the message if it fails."""
    done = subprocess.run(
        command,
        cwd=WEB,
        env=os.environ | environment,
        timeout=MAX_SECONDS,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
    )
    assert done.returncode == 0, done.stdout[-6000:]
    return done.stdout
