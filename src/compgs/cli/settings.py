"""Settings from the command line: `--set section.key=value`, read by the type that the setting has."""

import types
import typing
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from compgs.cli.usage import OPTIONS, UsageError, settings_of_options
from compgs.config import Config, config_from_dict
from compgs.former_settings import FORMER
from compgs.methods import Method


def assigned(options: Mapping[str, object], more: Sequence[str]) -> tuple[str, ...]:
    """Options that are settings, by the settings' names, as `section.key=value`, those that are given; then `more`."""
    return (*(f"{name}={value}" for name, value in options.items() if value is not None), *more)


def with_settings(config: Config, assignments: Iterable[str]) -> Config:
    """The config with `section.key=value` assignments applied, checked. Raises UsageError."""
    values = config.to_dict()
    kinds = typing.get_type_hints(type(config))
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        section, dot, key = name.strip().partition(".")
        if not (equals and dot):
            raise UsageError(f"--set {assignment}: expected section.key=value, as in training.steps=5000")
        if section not in kinds:
            raise UsageError(
                f"--set {assignment}: there is no section {section!r}; there are {', '.join(kinds)}"
            )
        hints = typing.get_type_hints(kinds[section])
        if f"{section}.{key}" in FORMER:
            instead = FORMER[f"{section}.{key}"].instead
            raise UsageError(f"--set {assignment}: {key!r} is no setting any more; {instead}")
        if key not in hints:
            raise UsageError(
                f"--set {assignment}: there is no setting {key!r}; {section} has {', '.join(hints)}"
            )
        try:
            values[section][key] = parse_value(hints[key], text.strip())
        except ValueError as error:
            raise UsageError(f"--set {assignment}: {error}") from error
    with settings_of_options():
        return config_from_dict(values, "--set", type(config))


def check_settings_of(method: Method, assignments: Iterable[str]) -> None:
    """Raises UsageError for a `section.key=value` assignment of a setting that the method does not use."""
    sections = typing.get_type_hints(method.settings)
    for assignment in assignments:
        name = assignment.partition("=")[0].strip()
        section = name.partition(".")[0]
        if section in sections and section not in method.uses and name not in method.uses:
            ours = ", ".join(f"{each}.*" if "." not in each else each for each in method.uses)
            raise UsageError(
                f"{OPTIONS.get(name, f'--set {name}')}: not a setting of --method {method.name}, which has {ours}"
            )


def parse_value(kind: Any, text: str) -> Any:
    """Raises ValueError that says what was expected."""
    origin, options = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Literal:
        for option in options:  # which need not be texts
            if text == str(option):
                return option
        raise ValueError(f"expected one of {', '.join(map(str, options))}, found {text!r}")
    if origin in (types.UnionType, typing.Union):
        if text.lower() == "none":
            return None
        return parse_value(next(option for option in options if option is not types.NoneType), text)
    if origin is tuple:
        parts = [part for part in text.strip("()[] ").split(",") if part.strip()]
        if options[-1] is Ellipsis:  # as many as there are
            options = (options[0],) * len(parts)
        if len(parts) != len(options):
            raise ValueError(f"expected {len(options)} numbers with a comma between them, found {text!r}")
        return tuple(parse_value(option, part.strip()) for option, part in zip(options, parts, strict=True))
    if kind is bool:
        if text.lower() not in ("true", "false"):
            raise ValueError(f"expected true or false, found {text!r}")
        return text.lower() == "true"
    try:
        return kind(text)
    except ValueError as error:
        expected = {int: "a whole number", float: "a number"}.get(kind, kind.__name__)
        raise ValueError(f"expected {expected}, found {text!r}") from error
