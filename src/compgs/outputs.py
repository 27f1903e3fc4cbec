"""Places to write to: checked before any work is done; a written file is whole or not there."""

import contextlib
import json
import math
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from compgs.errors import OutputError

LOCK_NAME = ".lock"  # in a folder that a process is writing (`occupied.py`), or that one was writing when it was killed


def check_output_file(path: Path, *, overwrite: bool = False, needed_bytes: int = 1 << 20) -> None:
    """Raises OutputError if `path` exists (unless `overwrite`) or could not be written."""
    if path.is_dir():
        raise OutputError(f"{path}: expected a file to write, found a folder; name a file inside it")
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: exists already; choose another name or give overwrite=True")
    _check_place(path.parent, needed_bytes)


def check_output_folder(folder: Path, *, overwrite: bool = False, needed_bytes: int = 16 << 20) -> None:
    """Raises OutputError if `folder` holds something (unless `overwrite`) or could not be written to."""
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: expected a folder to write to, found a file; choose another name")
    if folder.is_dir() and not overwrite and _holds_something(folder):
        raise OutputError(
            f"{folder}: exists already and is not empty; choose another folder or give overwrite=True"
        )
    _check_place(folder, needed_bytes)


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yields a new, empty file that takes the place of `path` when the block is done; folders on the way are made.

    Whatever happens inside, `path` is the old file or the whole new one, and nothing else stays. The new file's name
    cannot be foreseen, and no file or link that is there already is ever opened.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name[:40]}.{secrets.token_hex(8)}.partial")
    # Readable for whom the user's umask says, unlike the files of `tempfile`.
    os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    try:
        mode = temporary.stat().st_mode
        yield temporary
        temporary.chmod(mode)  # a writer may have made the file anew, for its own eyes only
        os.replace(temporary, path)
    except BaseException:
        _remove(temporary)
        raise


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file whole or not at all; folders on the way are made. Raises OutputError."""
    with _written(path), replacing(path) as temporary:
        temporary.write_bytes(data)


@contextlib.contextmanager
def filling(folder: Path) -> Iterator[Path]:
    """Yields a new folder; what is in it when the block is done takes its place in `folder`, which is made if need be.

    Until then `folder` is as it was, and if the block fails, it stays so. Files of the same names are replaced.
    Numbered pictures (`00007.png`) that are beside new ones and not among them are of something earlier: they go.
    Raises OutputError.
    """
    with contextlib.ExitStack() as stack:
        with _written(folder):
            folder.parent.mkdir(parents=True, exist_ok=True)
            place = tempfile.TemporaryDirectory(prefix=f".{folder.name[:40]}.", dir=folder.parent)
        temporary = Path(stack.enter_context(place))
        yield temporary
        with _written(folder):
            _move_files(temporary, folder)


@contextlib.contextmanager
def _written(path: Path) -> Iterator[None]:
    """Raises OutputError for what the system refuses inside."""
    try:
        yield
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error


def _move_files(source: Path, target: Path) -> None:
    files = sorted(path for path in source.rglob("*") if path.is_file())
    for file in files:
        place = target / file.relative_to(source)
        place.parent.mkdir(parents=True, exist_ok=True)
        os.replace(file, place)
    new = {target / file.relative_to(source) for file in files}
    for parent in {path.parent for path in new if _numbered(path)}:
        for old in parent.iterdir():
            if _numbered(old) and old not in new:
                _remove(old)


def _numbered(path: Path) -> bool:
    return path.suffix == ".png" and len(path.stem) == 5 and path.stem.isdigit()


def write_json(path: Path, content: dict[str, Any] | list[Any]) -> None:
    """JSON for programs, indented for people."""
    # Names of files need not be text: what is not becomes an escape of JSON, from which it can be read back.
    write_bytes(path, (json_text(content) + "\n").encode("utf-8", "backslashreplace"))


def json_text(content: dict[str, Any] | list[Any]) -> str:
    """JSON, indented. It has no infinity and no not-a-number: those become null."""
    return json.dumps(_finite(content), indent=2, ensure_ascii=False, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _holds_something(folder: Path) -> bool:
    try:
        return any(path.name != LOCK_NAME for path in folder.iterdir())
    except OSError as error:
        raise OutputError(f"{folder}: cannot be read ({error.strerror})") from error


def _check_place(folder: Path, needed_bytes: int) -> None:
    """`folder` need not exist: what counts is the nearest folder that does. Nothing is left behind."""
    nearest = folder.absolute()
    while not nearest.exists():
        nearest = nearest.parent
    if not nearest.is_dir():
        raise OutputError(f"{folder}: {nearest} is a file, not a folder; choose another place")
    try:
        # Permissions, read-only file systems and quotas show when something is written, not before.
        with tempfile.TemporaryFile(dir=nearest) as probe:
            probe.write(bytes(4096))
            probe.flush()
    except OSError as error:
        raise OutputError(
            f"{folder}: {nearest} cannot be written to ({error.strerror}); choose another place"
        ) from error
    free = shutil.disk_usage(nearest).free
    if free < needed_bytes:
        raise OutputError(
            f"{folder}: the disk is full: at least {needed_bytes / 1e6:.0f} MB are needed, "
            f"{free / 1e6:.1f} MB are free; make room or choose another place"
        )


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)
