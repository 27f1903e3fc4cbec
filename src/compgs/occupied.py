"""A folder that is written for minutes belongs to one process: a second one is refused, and told which the first is.

The system holds the lock (`flock`) and lets go of it when the process ends, however it ends: what a killed process
leaves behind is a file that stands in nobody's way. Where there are no such locks (Windows, some network file systems)
nobody is refused.
"""

import contextlib
import json
import os
import shlex
import socket
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from compgs.errors import OutputError
from compgs.outputs import LOCK_NAME

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

PATIENCE = 2.0  # seconds; a process that is just ending is waited for
PAUSE = 0.05  # seconds between two tries

_held: set[Path] = set()  # by this process


@contextlib.contextmanager
def occupied(folder: str | Path) -> Iterator[None]:
    """Inside, the folder, which is made if need be, belongs to this process; it may ask for it several times.

    Raises OutputError where another process has it, or it cannot be made. If nothing is in it at the end, a folder that
    was made goes again.
    """
    folder = Path(folder)
    place = folder.resolve()
    if place in _held or fcntl is None:
        yield
        return
    made = [path for path in (place, *place.parents) if not path.exists()]
    try:
        lock = _locked(folder)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written to ({error.strerror or error})") from error
    _held.add(place)
    try:
        yield
    finally:
        _held.discard(place)
        if lock is not None:
            _unlock(place / LOCK_NAME, lock)
        for path in made:
            with contextlib.suppress(OSError):  # there is something in it
                path.rmdir()


def occupied_if_given(folder: str | Path | None) -> contextlib.AbstractContextManager[None]:
    """`occupied`, for a folder that need not be given."""
    return contextlib.nullcontext() if folder is None else occupied(folder)


def _locked(folder: Path) -> BinaryIO | None:
    """The file that stands for the folder, locked; None where the file system has no locks. Raises OutputError."""
    path = folder.resolve() / LOCK_NAME
    end = time.monotonic() + PATIENCE
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("a+b")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            who = _who(file)
            file.close()
            if time.monotonic() > end:
                raise OutputError(
                    f"{folder}: another process is writing there: {who}; wait until it is done, stop it, or choose "
                    "another folder"
                ) from None
            time.sleep(PAUSE)
            continue
        except OSError:
            file.close()
            path.unlink(missing_ok=True)
            return None
        if _is_at(file, path):
            file.truncate(0)
            file.write(_ourselves())
            file.flush()
            return file
        file.close()  # who had it has removed it meanwhile


def _unlock(path: Path, file: BinaryIO) -> None:
    """Remove the file while it is still locked, so that nobody else locks one that is about to go."""
    with contextlib.suppress(OSError):
        if _is_at(file, path):
            path.unlink()
    file.close()


def _is_at(file: BinaryIO, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except OSError:
        return False


def _ourselves() -> bytes:
    name, *arguments = sys.argv or [""]
    program = "compgs" if Path(name).parent.name == "compgs" else Path(name).name
    return json.dumps(
        {
            "process": os.getpid(),
            "machine": socket.gethostname(),
            "command": shlex.join([program, *arguments]),
            "since": time.strftime("%Y-%m-%d %H:%M:%S"),
        }
    ).encode()


def _who(file: BinaryIO) -> str:
    """The process that a locked file names."""
    try:
        file.seek(0)
        facts = json.loads(file.read(1 << 16))
        return (
            f"{facts['command']} (process {facts['process']} on {facts['machine']}, since {facts['since']})"
        )
    except (OSError, ValueError, KeyError, TypeError):
        return "it has not said which it is"
