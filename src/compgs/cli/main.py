"""`compgs`: dispatch to a command; errors become one clear message and an exit code.

Exit codes: 0 done; 1 something is wrong with the input, the output or the file; 2 the command line could not be
understood, or has a value that is out of range; 130 stopped by the user (Ctrl-C), 143 by the system (SIGTERM).
"""

import sys
from collections.abc import Sequence

from rich.markup import escape
from rich.table import Table

from compgs import __version__
from compgs.cli.adjust import Adjust
from compgs.cli.arguments import command_name, parse_command
from compgs.cli.benchmark import Benchmark
from compgs.cli.command import Command
from compgs.cli.compare import Compare
from compgs.cli.compiling import say_when_compiling
from compgs.cli.compress import Compress
from compgs.cli.console import console, errors, show_whatever_can_be_shown, speak
from compgs.cli.decode import Decode
from compgs.cli.demo_scene import DemoScene
from compgs.cli.encode import Encode
from compgs.cli.evaluate import Evaluate
from compgs.cli.export import Export
from compgs.cli.info import Info
from compgs.cli.moved import in_words_of_today
from compgs.cli.notes import notes_shown
from compgs.cli.reconstruct import Reconstruct
from compgs.cli.render import Render
from compgs.cli.report import Report
from compgs.cli.serve import Serve
from compgs.cli.streams import give_up_stdout, open_closed_streams
from compgs.cli.swapped import exchanged
from compgs.cli.tiles import Tiles
from compgs.cli.train import Train
from compgs.cli.usage import UsageError, in_words_of_options
from compgs.cli.view import View
from compgs.errors import CompGSError, OutputError
from compgs.interrupt import Terminated, ended_on_request, held_back

COMMANDS: tuple[type[Command], ...] = (
    Reconstruct,
    Adjust,
    Train,
    Tiles,
    Compress,
    Encode,
    Decode,
    Render,
    Evaluate,
    View,
    Compare,
    Report,
    Benchmark,
    Export,
    Serve,
    Info,
    DemoScene,
)

EXAMPLE = "compgs demo-scene demo/scene && compgs train demo/scene -o demo/run --preset quick"


def print_help() -> None:
    """What `compgs` and `compgs --help` show."""
    console.print(f"[bold]compgs[/] {__version__}: compressed Gaussian splatting")
    console.print("Photographs in, one small file out, the same scene on every machine.\n")
    console.print(r"usage: compgs COMMAND \[OPTIONS]" + "\n")
    table = Table(box=None, pad_edge=False, show_header=False)
    for command in COMMANDS:
        table.add_row(
            f"  [bold]{command_name(command)}[/]", escape((command.__doc__ or "").partition("\n")[0])
        )
    console.print(table)
    console.print("\ncompgs COMMAND --help explains a command, compgs --version shows the version.")
    console.print(f"A first try: {EXAMPLE}")


def parse(words: Sequence[str]) -> Command:
    """Raises UsageError for words that are not understood, SystemExit(0) after a command's --help."""
    return parse_command(COMMANDS, in_words_of_today(words))


def main(arguments: Sequence[str] | None = None) -> int:
    """The exit code."""
    open_closed_streams()
    try:
        code = dispatched(arguments)
        sys.stdout.flush()
        return code
    except BrokenPipeError:
        give_up_stdout()
        return 1
    except OSError as error:
        give_up_stdout()
        return fail(OutputError(f"standard output: cannot be written ({error.strerror or error})"))


def dispatched(arguments: Sequence[str] | None = None) -> int:
    """The exit code. Raises BrokenPipeError when nobody reads on, OSError where standard output cannot be written."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    show_whatever_can_be_shown()
    speak()
    if given in (["--version"], ["-V"]):
        print(f"compgs {__version__}")
        return 0
    if given in ([], ["--help"], ["-h"]):
        print_help()
        return 0
    try:
        command = parse(given)
    except SystemExit:
        return 0
    except UsageError as error:
        return fail(error)
    return run(command, given)


def run(command: Command, words: Sequence[str]) -> int:
    """The exit code; unexpected exceptions, which are our mistakes, keep their traceback."""
    speak(quiet=command.quiet, results_alone=command.prints_results_alone)
    say_when_compiling()
    try:
        with ended_on_request(), notes_shown():
            command.check_machine()
            command.run()
    except BrokenPipeError:
        raise
    except (CompGSError, OSError, MemoryError) as error:
        if command.debug:
            raise
        return fail(error, exchanged(command, words))
    except KeyboardInterrupt as stop:
        with held_back():
            errors.print(escape(str(stop) or "interrupted"))
        return 143 if isinstance(stop, Terminated) else 130
    finally:
        speak()  # whoever calls `main` from Python may say something afterwards
    return 0


def fail(error: Exception, meant: str | None = None) -> int:
    """Says what is wrong, and which command was probably `meant`; the exit code."""
    errors.print(f"[bold red]error:[/] {escape(explain(error))}")
    if meant is not None:
        errors.print(f"did you mean: {escape(meant)}")
    return 2 if isinstance(error, UsageError) else 1


def explain(error: Exception) -> str:
    """One message that says what is wrong and where."""
    if isinstance(error, MemoryError):
        return "not enough memory; try a smaller scene, or read smaller images with -r"
    if isinstance(error, OSError):
        place = f"{error.filename}: " if error.filename else ""
        return f"{place}{error.strerror or error}"
    return in_words_of_options(str(error))


if __name__ == "__main__":
    sys.exit(main())
