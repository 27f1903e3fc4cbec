"""What a training says of cameras that came with a capture: nobody knows how exact they are."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from compgs.cli.console import say, warn

if TYPE_CHECKING:
    from compgs.scene import Scene


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


def warn_of_other_cameras(scene: "Scene") -> None:
    """Say before a long training that the photographs may not be those that the cameras took."""
    from compgs.scene.agreement import LEAST_AGREEMENT, color_agreement

    agreement = color_agreement(scene)
    if agreement is not None and agreement < LEAST_AGREEMENT:
        warn(
            f"{scene.source}: the photographs do not look as if these cameras had taken them: points have the colors "
            f"of their places in {agreement:.1f} times as many cases as by chance, where captures have more than 2; "
            "look whether names and poses belong together, or find poses anew: compgs reconstruct"
        )
