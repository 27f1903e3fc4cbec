"""The jobs of a suite on the machines of a Ray cluster: each a task with its needs, retried where a worker dies.

Data and output are on storage that all machines share, under the same path. What a task does is what happens without a
cluster: `run_job`, which continues a run that was stopped. So a worker that is killed costs the time since the last
checkpoint of one run, and nothing else.
"""

import logging
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from compgs.errors import ConfigError
from compgs.extras import require
from compgs.suites.jobs import Job, Outcome, run_job

LOCAL = "local"  # a cluster of this machine alone
RETRIES = 3  # of a task whose worker died


@dataclass(frozen=True)
class Needs:
    """What a job takes of a machine."""

    cpus: float = 1
    gpus: float = 0


def check_ray() -> None:
    """Raises MissingDependency, with the remedy, where Ray is not installed."""
    require("cluster", "--cluster")


def run_on_cluster(
    jobs: Sequence[Job],
    address: str,
    needs: Needs | None = None,
    started: Callable[[Job], None] | None = None,
) -> Iterator[Outcome]:
    """Yields what became of each as it is done, in no order. Raises ConfigError for a cluster that is out of reach."""
    check_ray()
    import ray
    import ray.exceptions

    needs = needs or Needs()
    own = not ray.is_initialized()
    stops = signal.getsignal(signal.SIGTERM)
    if own:
        try:
            # Workers start with what this process can import; they print to their runs' folders.
            ray.init(
                address=None if address == LOCAL else address,
                include_dashboard=False if address == LOCAL else None,
                log_to_driver=False,
                logging_level=logging.WARNING,
            )
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise ConfigError(f"--cluster {address}: cannot be reached ({error}); is it running?") from error
        finally:
            if threading.current_thread() is threading.main_thread():
                signal.signal(signal.SIGTERM, stops)  # Ray has put its own in the place of ours
    try:
        task = ray.remote(num_cpus=needs.cpus, num_gpus=needs.gpus, max_retries=RETRIES)(run_job)
        waiting: dict[Any, Job] = {}
        for job in jobs:
            if job.done:
                yield Outcome(job)
                continue
            if started is not None:
                started(job)
            waiting[task.remote(job)] = job
        while waiting:
            ready, _ = ray.wait(list(waiting), num_returns=1)
            for reference in ready:
                job = waiting.pop(reference)
                try:
                    yield ray.get(reference)
                except (ray.exceptions.RayError, OSError) as error:
                    # Its worker died more often than it is retried, or its machine cannot write.
                    yield Outcome(job, str(error).strip().partition("\n")[0])
    finally:
        if own:
            ray.shutdown()
