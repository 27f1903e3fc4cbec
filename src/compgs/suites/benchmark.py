"""A suite from its file to its tables."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from compgs.errors import CompGSError, ConfigError
from compgs.evaluation.reports.tables import Table
from compgs.occupied import occupied
from compgs.suites.cluster import Needs, check_ray, run_on_cluster
from compgs.suites.jobs import Job, Outcome, check_scenes, jobs_of
from compgs.suites.results import write_results
from compgs.suites.serial import run_serially
from compgs.suites.suite import SetValue, Suite


@dataclass(frozen=True)
class Benchmark:
    """What came out."""

    tables: tuple[Table, ...]
    files: tuple[Path, ...]
    failed: tuple[Outcome, ...]
    jobs: int


def benchmark(
    suite: Suite,
    output: str | Path,
    *,
    data: str | Path = ".",
    scenes: Sequence[str] = (),
    methods: Sequence[str] = (),
    cluster: str | None = None,
    needs: Needs | None = None,
    progress: Callable[[int, int, str], None] | None = None,
) -> Benchmark:
    """Run what of a suite has not been run, and write its tables and its report into `output`.

    `data`: folder of the scenes. `scenes`, `methods`: names of some, else all. `cluster`: address of a Ray cluster, or
    "local"; None: one run after the other. `progress(done, total, what)` is called when runs begin and end. Runs
    that fail are left out and said; the others stay, and the same call runs them again.

    Raises SceneError for missing scenes, ConfigError, MissingDependency, OutputError; ReportError if all runs failed.
    """
    chosen, notes = measurable(some_of(suite, scenes, methods))
    folder = Path(output).absolute()
    data_folder = Path(data).absolute()
    check_scenes(chosen, data_folder)
    if cluster is not None:
        check_ray()
    with occupied(folder):
        return _benchmark(
            chosen, notes, jobs_of(chosen, data_folder, folder), folder, cluster, needs, progress
        )


def _benchmark(
    suite: Suite,
    notes: list[str],
    jobs: Sequence[Job],
    folder: Path,
    cluster: str | None,
    needs: Needs | None,
    progress: Callable[[int, int, str], None] | None,
) -> Benchmark:
    """Run the jobs in a folder that is this process's until the end."""
    outcomes: list[Outcome] = []
    show = progress or (lambda done, total, what: None)
    show(0, len(jobs), "")

    def started(job: Job) -> None:
        show(len(outcomes), len(jobs), in_words(job))

    running: Iterator[Outcome] = (
        run_serially(jobs, started) if cluster is None else run_on_cluster(jobs, cluster, needs, started)
    )
    for outcome in running:
        outcomes.append(outcome)
        show(len(outcomes), len(jobs), in_words(outcome.job))
    failed = tuple(outcome for outcome in outcomes if outcome.error)
    notes += [f"{in_words(outcome.job)} failed: {outcome.error}" for outcome in failed]
    tables, files = write_results(suite, jobs, folder, notes)
    return Benchmark(tuple(tables), tuple(files), failed, len(jobs))


def some_of(suite: Suite, scenes: Sequence[str], methods: Sequence[str]) -> Suite:
    """Raises ConfigError for a name that the suite does not have."""
    for asked, known, what in (
        (scenes, [scene.name for scene in suite.scenes], "scenes"),
        (methods, [method.name for method in suite.methods], "methods"),
    ):
        for name in asked:
            if name not in known:
                raise ConfigError(f"{what} {name!r}: not in the suite, which has {', '.join(known)}")
    return replace(
        suite,
        scenes=tuple(scene for scene in suite.scenes if not scenes or scene.name in scenes),
        methods=tuple(method for method in suite.methods if not methods or method.name in methods),
    )


def measurable(suite: Suite) -> tuple[Suite, list[str]]:
    """Leave out LPIPS or FLIP where they cannot be measured, which is said: the rest of a table is worth having."""
    from compgs.metrics import check_flip, lpips_network

    notes = []
    weights = suite.train.get("lpips_weights")
    for name, check in (
        ("lpips", lambda: lpips_network(None if weights is None else str(weights))),
        ("flip", check_flip),
    ):
        if not (suite.train.get(name) or (name == "lpips" and weights)):
            continue
        try:
            check()
        except CompGSError as reason:
            suite = replace(suite, train=_without(name, suite.train))
            notes.append(f"{name.upper()} is unavailable: {reason}")
    return suite, notes


def _without(name: str, options: Mapping[str, SetValue]) -> dict[str, SetValue]:
    return {key: value for key, value in options.items() if key.removesuffix("_weights") != name}


def in_words(job: Job) -> str:
    return ", ".join(part for part in (job.scene, job.method, job.rate, f"seed {job.seed}") if part)
