"""From the words of a command line to a command; what cannot be understood is said in a line or two of our own."""

import contextlib
import difflib
import io
import itertools
import types
import typing
from collections.abc import Sequence
from typing import Any

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from compgs.cli.command import Command
from compgs.cli.settings import parse_value
from compgs.cli.usage import UsageError

METAVARS = {int: "INT", float: "FLOAT"}
# What the parser draws around its complaints and between their paragraphs, depending on terminal and version.
FRAME, RULE = "╭╮╰╯│┌┐└┘├┤─━ |", "─━- "


def parse_command(commands: Sequence[type[Command]], words: Sequence[str]) -> Command:
    """Raises UsageError for words that are not understood, SystemExit(0) after a command's --help."""
    names = [command_name(command) for command in commands]
    if words[0] not in names:
        raise UsageError(
            f"{words[0]}: there is no such command{_meant(words[0], names)}; there are {', '.join(names)}"
        )
    kind = commands[names.index(words[0])]
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint), _values():
            form: Any = typing.Annotated[kind, tyro.conf.configure(tyro.conf.OmitArgPrefixes)]
            command, unknown = tyro.cli(
                form,
                prog=f"compgs {words[0]}",
                args=list(words[1:]),
                return_unknown_args=True,
            )
    except SystemExit as stop:
        if not stop.code:
            raise
        raise UsageError(f"{_first_paragraph(complaint.getvalue())}\n{_help_line(words[0])}") from None
    if unknown:
        options = [f"--{name.replace('_', '-')}" for name in kind.__dataclass_fields__]
        raise UsageError(
            f"{unknown[0]}: compgs {words[0]} has no use for it{_meant(unknown[0], options)}\n"
            f"{_help_line(words[0])}"
        )
    return command


def command_name(command: type[Command]) -> str:
    """`DemoScene` is `demo-scene`."""
    return "".join(f"-{c.lower()}" if c.isupper() else c for c in command.__name__).lstrip("-")


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
            instance_from_str=lambda texts: parse_value(kind, ",".join(texts)),
            is_instance=lambda value: True,  # asked only within unions, which are taken whole here
            str_from_instance=lambda value: list(map(str, value if isinstance(value, tuple) else [value])),
        )

    return registry


def _without_none(kind: Any) -> Any:
    """`int` of `int | None`, and of `int`."""
    if typing.get_origin(kind) not in (types.UnionType, typing.Union):
        return kind
    others = [option for option in typing.get_args(kind) if option is not types.NoneType]
    return others[0] if len(others) == 1 else kind


def _meant(word: str, known: Sequence[str]) -> str:
    close = difflib.get_close_matches(word, known, n=1)
    return f" (did you mean {close[0]}?)" if close else ""


def _first_paragraph(complaint: str) -> str:
    """The parser's message in one line, without the heading and the frame around it, or the help below it."""
    lines = [line.strip(FRAME) for line in complaint.strip().splitlines()]
    paragraphs = [
        " ".join(group)
        for is_rule, group in itertools.groupby(lines, key=lambda line: not line.strip(RULE))
        if not is_rule
    ]
    return "".join(paragraphs[1:2] or paragraphs[:1]).removeprefix("Error parsing ")


def _help_line(name: str) -> str:
    return f"compgs {name} --help shows what it takes"
