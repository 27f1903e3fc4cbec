"""Says why the first command on a machine takes longer."""

import functools

from compgs.cli.console import say
from compgs.numerics.compiling import COMPILING

PATIENCE = 0.5  # seconds of compiling that nobody needs to hear of
MESSAGE = "compiling, once on this machine"


@functools.cache
def say_when_compiling() -> None:
    """Let MESSAGE appear once, when this process compiles for longer than a moment."""
    COMPILING.listen(Announcement())


class Announcement:
    """Called before each compilation."""

    def __init__(self) -> None:
        self.said = False

    def __call__(self, seconds: float) -> None:
        if seconds > PATIENCE and not self.said:
            self.said = True
            say(MESSAGE)
