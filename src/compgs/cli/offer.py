"""Photographs without poses, given where a scene is expected: on a terminal, finding the poses is offered."""

import sys
from dataclasses import replace
from pathlib import Path

from rich.prompt import Confirm

from compgs.cli.console import console, say
from compgs.cli.reconstruct import Reconstruct
from compgs.cli.run_folder import SceneSource


def with_poses(source: SceneSource) -> SceneSource | None:
    """The scene that was made of the photographs of `source`; None where nobody can be asked, or said no.

    Raises what `compgs.reconstruct.reconstruct` raises.
    """
    from compgs.reconstruct import holds_photographs

    folder = Path(source.path)
    target = folder.with_name(f"{folder.resolve().name}_scene")
    if not (console.is_terminal and sys.stdin.isatty() and holds_photographs(folder)) or target.exists():
        return None
    say(f"{folder}: photographs without poses")
    if not Confirm.ask(
        f"find them now, with COLMAP, and make the scene {target}?", console=console, default=True
    ):
        return None
    Reconstruct(photographs=folder, output=target).run()
    return replace(source, path=str(target))
