"""Commands that serve until they are stopped."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import pytest


@pytest.fixture
def serving() -> Callable[..., AbstractContextManager[subprocess.Popen[str]]]:
    """`with serving("serve", folder) as process`: `compgs` in a process of its own, which does not outlive the test."""

    @contextmanager
    def start(*arguments: str) -> Iterator[subprocess.Popen[str]]:
        process = subprocess.Popen(
            [sys.executable, "-m", "compgs", *arguments, "--port", "0"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONUNBUFFERED": "1"},
        )
        try:
            yield process
        finally:
            process.kill()
            process.wait()

    return start
