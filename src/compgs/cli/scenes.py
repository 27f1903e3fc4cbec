"""A scene for a command, with its progress and its notes shown."""

from pathlib import Path
from typing import TYPE_CHECKING

from compgs.cli.console import say
from compgs.cli.progress import counting
from compgs.cli.run_folder import SceneSource
from compgs.cli.usage import in_words_of_options

if TYPE_CHECKING:
    from compgs.scene import Scene


def read_scene(source: SceneSource, *, at_once: bool = True) -> "Scene":
    """`at_once`: photographs that fit into memory are decoded now. Raises SceneError."""
    from compgs.scene import load_scene

    with counting("reading views") as progress:
        scene = load_scene(
            Path(source.path),
            downscale=source.downscale,  # type: ignore[arg-type]  # checked there
            images=source.images,
            test_every=source.test_every,
            holdout=source.holdout,
            split=source.split,  # type: ignore[arg-type]
            background=source.background,
            progress=progress,
            at_once=at_once,
        )
    first = (scene.train_views or scene.test_views)[0].camera
    rule = f" ({scene.split})" if scene.split else ""
    say(
        f"{scene.name}: {len(scene.train_views)} training views, {len(scene.test_views)} held out{rule}, "
        f"{first.width} x {first.height} pixels, {len(scene.points.positions):,} points"
    )
    for note in scene.notes:
        say(f"note: {in_words_of_options(note)}")
    return scene
