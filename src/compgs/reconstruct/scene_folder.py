"""The folder of a scene, which appears when all of it is there."""

import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from compgs.occupied import occupied
from compgs.outputs import check_output_folder


@contextmanager
def new_scene(scene: Path, *, overwrite: bool) -> Iterator[Path]:
    """A folder for what is made on the way, which goes again; what is in its `scene` at the end becomes `scene`.

    Raises OutputError where a scene is there and is not to be replaced, or another process writes it.
    """
    check_output_folder(scene, overwrite=overwrite)
    work = scene.absolute().with_name(f".{scene.absolute().name}.{secrets.token_hex(8)}.partial")
    with occupied(scene):
        work.mkdir(parents=True)
        try:
            yield work
            _move_into_place(work / "scene", scene)
        finally:
            shutil.rmtree(work, ignore_errors=True)


def _move_into_place(new: Path, scene: Path) -> None:
    """An earlier folder stays until the new one takes its place."""
    earlier = new.with_name("earlier")
    if scene.exists():
        scene.rename(earlier)
    scene.parent.mkdir(parents=True, exist_ok=True)
    new.rename(scene)
