"""`compgs report`: one page on many runs, and its tables for programs and papers."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, Positional, arg

from compgs.cli.command import Command
from compgs.cli.console import say
from compgs.cli.progress import counting
from compgs.cli.usage import UsageError, check_range, settings_of_options
from compgs.words import size


@dataclass(frozen=True, kw_only=True)
class Report(Command):
    """Write one page on runs that opens offline: tables, quality over bytes with BD-rates, components, pictures.

    RUN is a folder that `compgs train` or `compgs evaluate -o` left, or a folder of such folders. Runs of one scene and
    preset over several lambdas form a curve; those that differ in their seeds only are averaged. What a run lacks is
    left out, and said. Beside the page stand its tables: .md, .tex, and a .csv for each.

    Examples

    compgs report runs/* -o report.html

    compgs report runs/ours runs/paper -o report.html --reference "compgs paper" --title "Two presets"
    """

    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN")]
    """Folders of runs."""

    output: Annotated[Path, arg(aliases=["-o"], metavar="PAGE.html")]
    """The page to write."""

    title: str = "Report"
    """Title of the page."""

    reference: Annotated[
        str | None, arg(metavar="METHOD", help_behavior_hint="(default: the first curve)")
    ] = None
    """Method that BD-rates are taken beside, as the report names it: "compgs paper"."""

    views: Annotated[int, arg(metavar="N")] = 4
    """Views of each scene that are shown, the worst."""

    overwrite: FlagCreatePairsOff[bool] = False
    """Replace a report that is there already."""

    def run(self) -> None:
        check_range("--views", self.views, 0, 1000)
        if not self.runs:
            raise UsageError("no run was given: name its folder; --help shows how")
        from compgs.evaluation.reports import report

        with settings_of_options(), counting("reading pictures") as progress:
            written = report(
                self.runs,
                self.output,
                title=self.title,
                reference=self.reference,
                views=self.views,
                overwrite=self.overwrite,
                progress=progress,
            )
        say(
            f"{written.page}: {size(written.page.stat().st_size)}; runs: {written.runs}, scenes: {written.scenes}"
        )
        say(f"beside it: {', '.join(file.name for file in written.files[1:])}")
        for note in written.notes:
            say(f"note: {note}")
