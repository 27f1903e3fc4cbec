"""The options of a command as its fields declare them, and what is wrong with words that do not fit them."""

import dataclasses
import re
import types
import typing
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from tyro.conf import FlagCreatePairsOff, Positional

POSITIONAL, WITHOUT_NO = (
    typing.get_args(marked)[1] for marked in (Positional[int], FlagCreatePairsOff[bool])
)


@dataclass(frozen=True)
class Option:
    """One argument of a command."""

    field: str  # of the command
    flags: tuple[str, ...]  # `--output`, `-o`; none for an argument that is known by its place
    placeholder: str  # what its values are called in the help
    values: int  # words that follow a flag
    required: bool

    @property
    def name(self) -> str:
        return self.flags[0] if self.flags else self.placeholder

    def as_typed(self, words: Sequence[str]) -> str:
        """The flag by which the option was given last, else its name."""
        flags = [flag for flag in map(_flag, words) if flag in self.flags]
        return flags[-1] if flags else self.name


def options_of(kind: type) -> list[Option]:
    """Return the options of a command, in the order of its fields."""
    hints = typing.get_type_hints(kind, include_extras=True)
    return [_option(field, hints[field.name]) for field in dataclasses.fields(kind)]


def misfit(options: Sequence[Option], words: Sequence[str]) -> str:
    """What is wrong with words that could not be matched to options: too few values, or an argument that is missing."""
    by_flag = {flag: option for option in options for flag in option.flags}
    for place, word in enumerate(words):
        flag, equals = _flag(word), "=" in word
        option = by_flag.get(flag)
        if option is None:
            continue
        following = 1 if equals else _values_after(words[place + 1 :])
        if option.values == 0 and equals:
            return f"{word}: {flag} takes no value"
        if following < option.values:
            expected = f"{option.values} values" if option.values > 1 else "a value"
            found = " ".join(words[place + 1 : place + 1 + following]) if following else "none"
            return f"{flag}: expected {expected} ({option.placeholder}), found {found}"
    given = {by_flag[flag].field for flag in map(_flag, words) if flag in by_flag}
    missing = [option for option in options if option.required and option.field not in given]
    # An argument that is known by its place is missing only if no option is.
    for option in sorted(missing, key=lambda option: not option.flags):
        return (
            f"{option.name} {option.placeholder} is missing" if option.flags else f"{option.name} is missing"
        )
    return f"{' '.join(words)}: these words do not fit together"


def _flag(word: str) -> str:
    """`--target-size` of `--target_size=2MB`."""
    flag = word.partition("=")[0]
    return flag.replace("_", "-") if flag.startswith("--") else flag


def _option(field: "dataclasses.Field[Any]", hint: Any) -> Option:
    annotated = typing.get_origin(hint) is typing.Annotated
    kind, *notes = typing.get_args(hint) if annotated else (hint,)
    aliases = [alias for note in notes for alias in getattr(note, "aliases", None) or ()]
    metavar = next((note.metavar for note in notes if getattr(note, "metavar", None)), None)
    name = field.name.replace("_", "-")
    flags = (f"--{name}", *aliases)
    if kind is bool and WITHOUT_NO not in notes:
        flags += (f"--no-{name}",)
    return Option(
        field=field.name,
        flags=() if POSITIONAL in notes else flags,
        placeholder=metavar or field.name.upper(),
        values=_count(kind),
        required=field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING,
    )


def _count(kind: Any) -> int:
    """Words that a value of the type takes; options that may be repeated take one at a time."""
    if typing.get_origin(kind) in (types.UnionType, typing.Union):
        return max(_count(part) for part in typing.get_args(kind) if part is not types.NoneType)
    if kind is bool:
        return 0
    if typing.get_origin(kind) is tuple and typing.get_args(kind)[-1] is not Ellipsis:
        return len(typing.get_args(kind))
    return 1


def _values_after(words: Sequence[str]) -> int:
    """How many words come before the next option; negative numbers are values."""
    for count, word in enumerate(words):
        if re.match(r"--?[A-Za-z]", word):
            return count
    return len(words)
