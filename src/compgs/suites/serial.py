"""The jobs of a suite, one after the other, on this machine."""

from collections.abc import Callable, Iterable, Iterator

from compgs.suites.jobs import Job, Outcome, run_job


def run_serially(jobs: Iterable[Job], started: Callable[[Job], None] | None = None) -> Iterator[Outcome]:
    """Yields what became of each as it is done; `started` is called before each."""
    for job in jobs:
        if started is not None and not job.done:
            started(job)
        yield run_job(job)
