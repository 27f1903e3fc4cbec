"""`compgs serve`: a gallery of files in the browser."""

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from compgs.cli.command import Command
from compgs.cli.console import announce, say
from compgs.cli.usage import UsageError, check_range

MAX_PORT = 65535


@dataclass(frozen=True, kw_only=True)
class Serve(Command):
    """Show the .cgs files of a folder in the browser: a list of them, and each one to walk around in.

    Only this machine can see them unless --host says otherwise. Ctrl-C ends it.

    Examples

    compgs serve runs

    compgs serve scenes --host 0.0.0.0 --port 80
    """

    folder: Annotated[Positional[Path], arg(metavar="FOLDER")] = Path(".")
    """Where the .cgs files are; folders within it count, too."""

    host: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1"
    """Address to listen at; 0.0.0.0 is all addresses of this machine."""

    port: Annotated[int, arg(metavar="N")] = 8000
    """Port to listen at; 0 takes a free one."""

    def run(self) -> None:
        from compgs.viewer.gallery import gallery_server, scene_files

        check_range("--port", self.port, 0, MAX_PORT)
        if not self.folder.is_dir():
            raise UsageError(f"{self.folder}: expected a folder with .cgs files")
        try:
            server = gallery_server(self.folder, self.host, self.port)
        except OSError as error:
            raise UsageError(
                f"--host {self.host} --port {self.port}: cannot be listened at ({error.strerror or error}); "
                "give another one; --port 0 takes a free port"
            ) from error
        count = len(scene_files(self.folder.resolve()))
        with server, contextlib.suppress(KeyboardInterrupt):  # whoever reads the address may end it at once
            announce(f"{count} {'file' if count == 1 else 'files'}: http://{self.host}:{server.server_port}/")
            server.serve_forever()
        say("ended")
