"""Runs `compgs` with the arguments it is given, and ends when the process that started it does.

A worker of a cluster may be killed in mid-run. Its run must then end, too, before another worker continues it from the
last checkpoint: two processes would write to one folder. The worker holds the other end of this process's standard
input, which the system closes when it dies.
"""

import os
import runpy
import sys
import threading


def main() -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    sys.argv[0] = "compgs"
    runpy.run_module("compgs", run_name="__main__", alter_sys=False)


def _end_with_parent() -> None:
    try:
        while os.read(0, 4096):
            pass
    except OSError:
        return  # no standard input: nobody to wait for
    os._exit(1)


if __name__ == "__main__":
    main()
