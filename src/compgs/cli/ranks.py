"""`compgs train` as one of several processes (torchrun): rank 0 speaks, writes and evaluates; all train."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

from compgs.cli.console import console, errors
from compgs.errors import CompGSError


@contextmanager
def among_ranks(device: str | None) -> Iterator[bool]:
    """Inside, the processes of a torchrun train one scene. Yields whether this one leads; a process by itself does.

    The others say nothing, but what goes wrong, and on which rank.
    """
    from compgs.training.run.distributed import joined, launched_rank
    from compgs.training.run.run import chosen_device

    rank = launched_rank()
    if rank == 0:
        with joined(chosen_device(device)):
            yield True
        return
    quiet, console.quiet = console.quiet, True
    try:
        with joined(chosen_device(device)):
            yield False
    except CompGSError as error:
        raise type(error)(f"rank {rank}: {error}") from error
    except KeyboardInterrupt:
        errors.quiet = True  # rank 0 has said it
        raise
    finally:
        console.quiet = quiet


def several() -> bool:
    """Whether this process is one of several."""
    from compgs.training.run.distributed import launched

    return launched()


def share_of_threads() -> int:
    """Threads for each process of a torchrun on this machine, where nobody has asked for a number."""
    import numba

    processes = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    return max(1, int(numba.config.NUMBA_NUM_THREADS) // processes)  # type: ignore[attr-defined]
