"""Text files of other programs, in the encodings that those write: UTF-8 with or without a mark, UTF-16 with one."""

import codecs
import json
from pathlib import Path
from typing import Any

from compgs.errors import SceneError

# What Windows programs put in front of a text. The longer marks first: UTF-32's begins as UTF-16's does.
_MARKS = (
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)


def decoded(content: bytes, errors: str = "strict") -> str:
    """The text, without a byte order mark. Raises UnicodeDecodeError, which is a ValueError."""
    encoding = next((name for mark, name in _MARKS if content.startswith(mark)), "utf-8-sig")
    return content.decode(encoding, errors)


def read_lines(file: Path) -> list[str]:
    """The lines of a file; bytes that are no text become surrogates, as Python has them in file names."""
    content = file.read_bytes()
    marked = any(content.startswith(mark) for mark, _ in _MARKS)
    return decoded(content, "replace" if marked else "surrogateescape").split("\n")


def read_json(file: Path) -> Any:
    """Raises SceneError that names the file."""
    try:
        return json.loads(decoded(file.read_bytes()))
    except OSError as error:
        raise SceneError(f"{file}: cannot be read ({error.strerror or error})") from error
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{file}: is not valid JSON ({error}); export it again") from error
