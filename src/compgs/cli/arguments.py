"""From the words of a command line to a command; what cannot be understood is said in a line or two of our own.

The parser library draws its complaints for a terminal. None of them is shown or read: values of which a number or a
choice is expected are all accepted by the parser, and refused here; for words that do not fit together we look
ourselves at what is missing (`options.py`).
"""

import contextlib
import difflib
import io
import shlex
import sys
import types
import typing
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from compgs.cli.command import Command
from compgs.cli.options import Option, misfit, options_of
from compgs.cli.settings import parse_value
from compgs.cli.usage import UsageError

METAVARS = {int: "INT", float: "FLOAT"}


@dataclass(frozen=True)
class Refused:
    """Stands for a value that could not be understood, until the name of its option is known."""

    complaint: str


def parse_command(commands: Sequence[type[Command]], words: Sequence[str]) -> Command:
    """Raises UsageError for words that are not understood, SystemExit(0) after a command's --help."""
    names = [command_name(command) for command in commands]
    if words[0] not in names:
        raise UsageError(
            f"{words[0]}: there is no such command{_meant_command(words, names)}; there are {', '.join(names)}"
        )
    kind = commands[names.index(words[0])]
    options = options_of(kind)
    shown = _Shown(sys.stdout)
    try:
        with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(shown), _values():
            form: Any = typing.Annotated[kind, tyro.conf.configure(tyro.conf.OmitArgPrefixes)]
            command, unknown = tyro.cli(
                form,
                prog=f"compgs {words[0]}",
                args=list(words[1:]),
                return_unknown_args=True,
            )
    except SystemExit as stop:
        if not stop.code:
            _, empty_line, explanation = shown.getvalue().partition("\n\n")
            sys.stdout.write(usage_of(words[0], kind.asked_for, options) + empty_line + explanation)
            raise
        raise UsageError(f"{misfit(options, words[1:])}\n{_help_line(words[0])}") from None
    if unknown:
        flags = [flag for option in options for flag in option.flags]
        raise UsageError(
            f"{unknown[0]}: compgs {words[0]} has no use for it{_meant(unknown[0], flags)}\n"
            f"{_help_line(words[0])}"
        )
    _check_values(command, options, words)
    return command


def command_name(command: type[Command]) -> str:
    """`DemoScene` is `demo-scene`."""
    return "".join(f"-{c.lower()}" if c.isupper() else c for c in command.__name__).lstrip("-")


def usage_of(name: str, asked_for: Sequence[str], options: Sequence[Option]) -> str:
    """`usage: compgs train SCENE -o RUN [OPTIONS]`: brackets are around what may be left out. `asked_for`: fields that
    may not, although the parser does without them.
    """
    needed = [option for option in options if option.required or option.field in asked_for]
    places = [
        option.placeholder if option in needed else f"[{option.placeholder}]"
        for option in sorted(options, key=lambda option: option not in needed)
        if not option.flags
    ]
    flags = [f"{min(option.flags, key=len)} {option.placeholder}" for option in needed if option.flags]
    return " ".join(["usage: compgs", name, *places, *flags, "[OPTIONS]"])


class _Shown(io.StringIO):
    """What the parser shows, before it is shown: as wide and colored as it would be on `stream`."""

    def __init__(self, stream: typing.TextIO) -> None:
        super().__init__()
        self.stream = stream

    def isatty(self) -> bool:
        return self.stream.isatty()


def _check_values(command: Command, options: Sequence[Option], words: Sequence[str]) -> None:
    """Raises UsageError for the first value that could not be understood."""
    for option in options:
        value = getattr(command, option.field)
        if isinstance(value, Refused):
            raise UsageError(f"{option.as_typed(words)}: {value.complaint}\n{_help_line(words[0])}")


def _values() -> ConstructorRegistry:
    """Numbers, choices and triples are read as settings are, with the same words for what was expected."""
    registry = ConstructorRegistry()

    @registry.primitive_rule
    def rule(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
        kind = _without_none(info.type)
        origin, parts = typing.get_origin(kind), typing.get_args(kind)
        if origin is typing.Literal:
            metavar, count = f"{{{','.join(map(str, parts))}}}", 1
        elif origin is tuple and set(parts) == {float}:
            metavar, count = " ".join(METAVARS[part] for part in parts), len(parts)
        elif kind in METAVARS:
            metavar, count = METAVARS[kind], 1
        else:
            return None
        return PrimitiveConstructorSpec(
            nargs=count,
            metavar=metavar,
            instance_from_str=lambda texts: _value(kind, texts),
            is_instance=lambda value: True,  # asked only within unions, which are taken whole here
            str_from_instance=lambda value: list(map(str, value if isinstance(value, tuple) else [value])),
        )

    return registry


def _value(kind: Any, texts: Sequence[str]) -> Any:
    """Return a value of the type `kind`, or `Refused`: to raise here would leave the message to the parser."""
    try:
        return parse_value(kind, ",".join(texts))
    except ValueError as error:
        return Refused(str(error))


def _without_none(kind: Any) -> Any:
    """`int` of `int | None`, and of `int`."""
    if typing.get_origin(kind) not in (types.UnionType, typing.Union):
        return kind
    others = [option for option in typing.get_args(kind) if option is not types.NoneType]
    return others[0] if len(others) == 1 else kind


def _meant(word: str, known: Sequence[str]) -> str:
    close = difflib.get_close_matches(word, known, n=1)
    return f" (did you mean {close[0]}?)" if close else ""


def _meant_command(words: Sequence[str], names: Sequence[str]) -> str:
    """Also where the command comes after what it is to be done with."""
    if len(words) > 1 and words[1] in names:
        return f" (did you mean compgs {shlex.join([words[1], words[0], *words[2:]])}?)"
    return _meant(words[0], names)


def _help_line(name: str) -> str:
    return f"compgs {name} --help shows what it takes"
