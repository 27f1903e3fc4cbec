"""Small pictures of .cgs files, and what is wrong with those that have none; each is made once for a file's content."""

import io
import threading
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from compgs.errors import CompGSError

WIDTH, HEIGHT = 320, 240  # pixels; the picture fills them
QUALITY = 85  # of JPEG
KEPT = 2000  # files whose state and picture are remembered

Content = tuple[Path, int, int]  # a file, its size, and when it was written


@dataclass
class _Known:
    """What has been found out about a file."""

    trouble: str | None = None  # in words; None: it is whole
    picture: bytes | None = None  # JPEG


class Thumbnails:
    """Pictures of the files of a gallery, and what is wrong with them; asked by several threads."""

    def __init__(self) -> None:
        self._known: dict[Content, _Known] = {}
        self._remembering = threading.Lock()
        self._drawing = threading.Lock()  # one scene at a time is in memory

    def trouble(self, file: Path) -> str | None:
        """What is wrong with a file, found without decoding it; None for one that is whole."""
        return self._of(file).trouble

    def picture(self, file: Path) -> bytes | None:
        """A JPEG of what the page shows first; None for a file that cannot be decoded, whose trouble is then known."""
        known = self._of(file)
        with self._drawing:
            if known.picture is None and known.trouble is None:
                try:
                    known.picture = _drawn(file)
                except (CompGSError, OSError, MemoryError) as error:
                    known.trouble = str(error) or type(error).__name__
        return known.picture

    def _of(self, file: Path) -> _Known:
        status = file.stat()
        content = file, status.st_size, status.st_mtime_ns
        with self._remembering:
            known = self._known.get(content)
        if known is None:
            known = _Known(_found_wrong(file))
            with self._remembering:
                while len(self._known) >= KEPT:
                    del self._known[next(iter(self._known))]
                self._known[content] = known
        return known


def _found_wrong(file: Path) -> str | None:
    from compgs.opening import check_scene

    try:
        check_scene(file)
    except (CompGSError, OSError) as error:
        return str(error).removeprefix(f"{file}: ")
    return None


def _drawn(file: Path) -> bytes:
    """Raises BitstreamError."""
    from compgs.evaluation.camera_path import first_view, whole
    from compgs.metrics import to_8bit
    from compgs.opening import open_scene
    from compgs.render import render
    from compgs.render.render_model import local_camera

    model = open_scene(file)
    if model.viewpoints:
        cameras = [local_camera(model, camera) for camera in model.viewpoints]
        camera = model.viewpoints[first_view(model.bounds[0], cameras)]
        scale = max(WIDTH / camera.width, HEIGHT / camera.height)
        camera = camera.resized(*(max(1, round(side * scale)) for side in (camera.width, camera.height)))
    else:
        camera = whole(model.bounds[0], frames=1, width=WIDTH, height=HEIGHT)[0][1]
        camera = camera.moved([-x for x in model.world_offset])
    picture = Image.fromarray(to_8bit(render(model, camera).image))
    left, top = (picture.width - WIDTH) // 2, (picture.height - HEIGHT) // 2
    out = io.BytesIO()
    picture.crop((left, top, left + WIDTH, top + HEIGHT)).save(out, "JPEG", quality=QUALITY)
    return out.getvalue()
