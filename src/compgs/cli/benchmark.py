"""`compgs benchmark`: a suite of runs, and the paper's tables of them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from compgs.cli.command import NO_DEFAULT, Command
from compgs.cli.console import say
from compgs.cli.progress import counting_runs
from compgs.cli.usage import UsageError, settings_of_options


@dataclass(frozen=True, kw_only=True)
class Benchmark(Command):
    """Run a suite of scenes, methods, rates and seeds, and write the tables of the paper.

    SUITE is a TOML file, or one that is shipped: bungeenerf, captures, deep_blending, mip_nerf_360, sector,
    tanks_and_temples, truck.
    Each run is a `compgs train` in a folder of its own. The same command goes on after a stop, and skips
    finished runs. OUT then has table.md, .csv and .tex (quality, with published rows marked as such), complexity.*, a
    table for each scene, and report.html.

    Examples

    compgs benchmark captures --data scenes -o benchmarks/captures

    compgs benchmark mip_nerf_360 --data datasets/360 --scenes garden --scenes room -o benchmarks/360

    compgs benchmark suite.toml --data scenes -o out --cluster local
    """

    suite: Annotated[Positional[str], arg(metavar="SUITE")]
    """A TOML file, or the name of a suite that is shipped."""

    output: Annotated[Path, arg(aliases=["-o"], metavar="OUT")]
    """Folder for runs, tables and report. On a cluster: on storage that all machines share."""

    data: Annotated[Path, arg(metavar="FOLDER")] = Path(".")
    """Folder of the scenes."""

    scenes: Annotated[tuple[str, ...], UseAppendAction, arg(metavar="NAME")] = ()
    """Run this scene only; may be repeated."""

    methods: Annotated[tuple[str, ...], UseAppendAction, arg(metavar="NAME")] = ()
    """Run this method only, by its name in the suite; may be repeated."""

    cluster: Annotated[str | None, arg(metavar="ADDRESS|local", help_behavior_hint=NO_DEFAULT)] = None
    """Run on a Ray cluster, or with several workers of this machine (`local`). Needs the extra `cluster`."""

    cpus: Annotated[float, arg(metavar="N")] = 1.0
    """CPU cores that a run takes on a cluster."""

    gpus: Annotated[float, arg(metavar="N")] = 0.0
    """GPUs that a run takes on a cluster; 0.5 puts two runs on one."""

    def run(self) -> None:
        from compgs.evaluation.reports.tables import to_markdown
        from compgs.suites import benchmark, load_suite
        from compgs.suites.benchmark import in_words
        from compgs.suites.cluster import Needs

        if self.cpus <= 0 or self.gpus < 0:
            raise UsageError(
                f"--cpus {self.cpus:g} --gpus {self.gpus:g}: expected cores above 0, no negative GPUs"
            )
        suite = load_suite(self.suite)
        with settings_of_options(), counting_runs("runs") as progress:
            done = benchmark(
                suite,
                self.output,
                data=self.data,
                scenes=self.scenes,
                methods=self.methods,
                cluster=self.cluster,
                needs=Needs(self.cpus, self.gpus),
                progress=progress,
            )
        say("")
        say(to_markdown(done.tables[0]))
        say(f"{self.output / 'report.html'}; tables as .md, .csv and .tex beside it")
        for outcome in done.failed:
            say(
                f"failed: {in_words(outcome.job)}: {outcome.error}; {outcome.job.folder / 'output.txt'} has the rest"
            )
        if done.failed:
            say(f"{len(done.failed)} of {done.jobs} runs failed; the same command runs them again")
