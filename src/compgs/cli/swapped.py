"""Two arguments in each other's place, as in `compgs evaluate SCENE FILE`: looked for when a command has failed."""

import itertools
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path

from compgs.cli.command import Command
from compgs.cli.options import Option, options_of
from compgs.errors import CompGSError


def exchanged(command: Command, words: Sequence[str]) -> str | None:
    """The command line with two of its arguments exchanged, where each fits in the other's place and not in its own."""
    given = {
        option: value
        for option in options_of(type(command))
        if isinstance(value := getattr(command, option.field), Path)
    }
    for one, other in itertools.combinations(given, 2):
        if _belongs(one, given[other]) and _belongs(other, given[one]):
            return _with_exchanged(words, given[one], given[other])
    return None


def _belongs(option: Option, path: Path) -> bool:
    """Whether a path is what an option asks for. A place to write to is one where there is nothing yet."""
    if option.field == "output":
        return not path.exists()
    is_asked_for = INPUTS.get(option.placeholder)
    return is_asked_for is not None and is_asked_for(path)


def _with_exchanged(words: Sequence[str], one: Path, other: Path) -> str | None:
    places = [[i for i, word in enumerate(words) if Path(word) == path] for path in (one, other)]
    if [len(found) for found in places] != [1, 1]:  # such as `--output=FILE`, or one path twice
        return None
    (first,), (second,) = places
    changed = list(words)
    changed[first], changed[second] = words[second], words[first]
    return shlex.join(["compgs", *changed])


def _holds_splats(path: Path) -> bool:
    from compgs.cli.run_folder import file_and_run
    from compgs.opening import format_of

    try:
        format_of(file_and_run(path)[0])
    except (CompGSError, OSError):
        return False
    return True


def _holds_capture(path: Path) -> bool:
    return path.is_dir() and (
        (path / "images").is_dir() or (path / "sparse").is_dir() or any(path.glob("transforms*.json"))
    )


def _holds_photographs(path: Path) -> bool:
    from compgs.reconstruct import holds_photographs
    from compgs.reconstruct.video import is_video

    return holds_photographs(path) or (path.is_file() and is_video(path))


def _holds_cameras(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() == ".json"


# What is asked for, by the placeholder that the help shows.
INPUTS: dict[str, Callable[[Path], bool]] = {
    "FILE": _holds_splats,
    "FILE|RUN": _holds_splats,
    "RUN|FILE": _holds_splats,
    "A": _holds_splats,
    "B": _holds_splats,
    "SCENE": _holds_capture,
    "SCENE|JSON": _holds_capture,
    "PHOTOS": _holds_photographs,
    "JSON": _holds_cameras,
}
