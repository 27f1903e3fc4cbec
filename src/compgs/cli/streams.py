"""The three standard streams, where whoever started the program has closed one (`compgs info FILE >&-`)."""

import contextlib
import os
import sys


def open_closed_streams() -> None:
    """Standard streams that are closed lead to nowhere from now on.

    Python has None in place of a closed stream, and the system gives its number to the next file that is opened: what
    a library prints would end up in that file. Both are prevented.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            # The lowest number that is free is taken: this one.
            with contextlib.suppress(OSError):
                os.open(os.devnull, os.O_RDONLY if number == 0 else os.O_WRONLY)
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115


def give_up_stdout() -> None:
    """Python writes what is left when it ends, which would fail again, with a traceback."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
