"""What a training says of cameras that came with a capture: nobody knows how exact they are."""

import shlex
from pathlib import Path

from compgs.cli.console import say


def adjusting_command(capture: Path) -> str:
    """The command that fits a capture's cameras to its photographs; empty where this program has fitted them already,
    or cannot.
    """
    from compgs.scene.doubt import cameras_from_elsewhere

    if not cameras_from_elsewhere(capture):
        return ""
    return f"compgs adjust {shlex.quote(str(capture))} -o {shlex.quote(f'{capture}_adjusted')}"


def say_cameras(capture: Path) -> None:
    """Name the command that makes a better capture in minutes, before a long training begins, if there may be one."""
    if adjusting := adjusting_command(capture):
        say(
            f"cameras: as they came with the capture; to fit them to the photographs first, in minutes: {adjusting}"
        )
