"""`compgs view`: a file in the browser, rendered by this process."""

import contextlib
import threading
import webbrowser
from dataclasses import dataclass
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, arg

from compgs.cli.command import NO_DEFAULT, DecodingCommand, MemoryOption, SceneFileOrRunArgument
from compgs.cli.console import announce, say
from compgs.cli.levels import LevelOption
from compgs.cli.run_folder import file_and_run
from compgs.cli.usage import UsageError, check_range
from compgs.cli.viewing import check_viewing, listening

MOST_SPLATS = 1_000_000_000


@dataclass(frozen=True, kw_only=True)
class View(DecodingCommand, SceneFileOrRunArgument, LevelOption, MemoryOption):
    """Show a file of splats in the browser: walk around in it, look behind it, record a flight.

    This process renders what each visitor sees, exactly: small pictures while the camera moves, one at the window's
    size when it rests. Drag to turn, right drag to move, scroll to come nearer, W A S D Q E to fly. The panel has
    the detail (the file is decoded from its beginning), anchors, ellipsoids and cameras to jump to, screenshots,
    and a camera path that becomes a video or a file for `compgs render --path`.

    Only this machine can see it unless --host says otherwise; nothing is loaded from elsewhere. Ctrl-C ends it.
    Needs `pip install '.[view]'` in the project's folder.

    Examples

    compgs view garden.cgs

    compgs view garden.ply --open

    compgs view garden.cgs --host 0.0.0.0 --port 9000
    """

    host: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1"
    """Address to listen at; 0.0.0.0 is all addresses of this machine."""

    port: Annotated[int, arg(metavar="N")] = 8080
    """Port to listen at; 0 takes a free one."""

    open: FlagCreatePairsOff[bool] = False
    """Open the browser of this machine."""

    background: Annotated[
        tuple[float, float, float] | None, arg(metavar="R G B", help_behavior_hint=NO_DEFAULT)
    ] = None
    """Color behind everything, 0 to 1, to begin with; by default the file's own, or black."""

    max_splats: Annotated[int, arg(metavar="N")] = 3_000_000
    """That a picture may have. Of tiles, what is near is then finer than what is far; of a .cgs file its finest parts
    are left out, of a lod-meta.json its finest levels."""

    def run(self) -> None:
        self.check_values()
        from compgs.opening import check_scene

        self.allow_memory()
        file, _ = file_and_run(self.file)
        check_scene(file)
        self.prepare("decode", "render")
        from compgs.devices import chosen_device
        from compgs.viewer.shown import FileShown
        from compgs.viewer.stage import OwnThread

        shown = FileShown(file, chosen_device(self.device), self.background, self.level, self.max_splats)
        with (
            listening(shown, OwnThread(self.prepare), self.host, self.port) as viewer,
            contextlib.suppress(KeyboardInterrupt),  # whoever reads the address may end it at once
        ):
            announce(f"{file}: {viewer.address}")
            if self.open:
                webbrowser.open(viewer.address)
            threading.Event().wait()
        say("ended")

    def check_values(self) -> None:
        """Raises UsageError, MissingDependency."""
        check_viewing(self.port)
        check_range("--max-splats", self.max_splats, 1, MOST_SPLATS)
        if self.background is not None and not all(0 <= part <= 1 for part in self.background):
            raise UsageError(f"--background {self.background}: expected three numbers from 0 to 1")
