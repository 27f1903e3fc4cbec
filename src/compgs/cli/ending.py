"""What is said when a training has ended."""

import shlex
from pathlib import Path

from compgs.cli.cameras import adjusting_command
from compgs.cli.console import say
from compgs.cli.run_folder import add_facts, file_name
from compgs.words import size

NOTABLE_MISS = 0.05  # of the size that was asked for


def say_next(file: Path, capture: Path) -> None:
    """Commands that somebody who has just trained a scene of a capture may want."""
    name = shlex.quote(str(file))
    commands = {f"compgs view {name}": "look at it in the browser"}
    if file.suffix == ".cgs":
        page = shlex.quote(f"{file.stem}.html")
        commands[f"compgs export {name} {page}"] = "one page to share, which opens from disk"
    else:
        commands[f"compgs info {name}"] = "what takes how many bytes"
    if adjusting := adjusting_command(capture):
        commands[adjusting] = "if it is soft: cameras that fit the photographs better"
    width = max(map(len, commands))
    for command, purpose in commands.items():
        say(f"next: {command:{width}}  # {purpose}")


def say_miss(folder: Path, target: int) -> None:
    """How far from the size that was asked for the file is; training.json gets it too."""
    written = (folder / file_name(folder)).stat().st_size
    miss = written / target - 1
    say(f"asked {size(target)}, written {size(written)}: {100 * miss:+.1f} %")
    facts = add_facts(folder, {"target_bytes": target, "bytes": written, "miss": miss})
    if abs(miss) > NOTABLE_MISS:
        from compgs.training.rate.rate_control import HIGHEST, LOWEST

        lmbda = (
            f"lambda ended at {facts['lmbda']:.3g}, within {LOWEST:g} to {HIGHEST:g}"
            if "lmbda" in facts
            else "lambda"
        )
        way = "fewer anchors (model.voxel_spacings)" if miss > 0 else "more anchors (model.voxel_spacings)"
        say(
            f"note: {size(written)} is what these settings reached ({lmbda}); more --steps let it settle, "
            f"{way} or another --preset move the range"
        )
