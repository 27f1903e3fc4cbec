"""What is wrong with a command line, in the words of its options."""

from collections.abc import Iterator
from contextlib import contextmanager

from compgs.errors import ConfigError, MissingDependency

# Settings that have an option of their own.
OPTIONS = {
    "training.lmbda": "--lmbda",
    "training.target_bytes": "--target-size",
    "training.steps": "--steps",
    "training.seed": "--seed",
}


# Messages of the package name arguments of Python functions; on the command line these options take their place.
OF_PYTHON = {
    "overwrite=True": "--overwrite",
    "resume=True": "--resume",
    "images=...": "--images",
    "downscale=...": "-r",
    "test_every=...": "--test-every",
    "split=": "--hold-out ",
    "(downscale=auto)": "(-r auto)",
    "downscale=1 ": "-r 1 ",
    "images=": "--images ",
}


class UsageError(ConfigError):
    """The command line cannot be understood as it stands, or asks for a value that is out of range."""


def check_range(option: str, value: float, low: float, high: float) -> None:
    """Raises UsageError for a value that is not a number from `low` to `high`."""
    if not low <= value <= high:
        raise UsageError(f"{option} {value}: expected {low} to {high}")


def in_words_of_options(message: str) -> str:
    """The message of an error for somebody who gives options, not arguments of functions."""
    for argument, option in OF_PYTHON.items():
        message = message.replace(argument, option)
    for setting, option in OPTIONS.items():
        message = message.replace(f"{setting} = ", f"{option} ")
    return message


@contextmanager
def settings_of_options() -> Iterator[None]:
    """A ConfigError of a setting that was given on the command line becomes a UsageError of the option."""
    try:
        yield
    except (UsageError, MissingDependency):
        raise
    except ConfigError as error:
        raise UsageError(_of_an_option(str(error))) from error


def _of_an_option(message: str) -> str:
    """`training.steps = 0: ...` is `--steps 0: ...`; where there is no such option, `--set training.steps=0: ...`. What
    does not begin with the name of a setting or an argument, but with that of a file, stays as it is.
    """
    name, _, rest = message.partition(" ")
    section, _, key = name.partition(".")
    if not (section.isidentifier() and (name == section or (key.isidentifier() and rest.startswith("= ")))):
        return message
    rest = rest.removeprefix("= ")
    if name in OPTIONS:
        return f"{OPTIONS[name]} {rest}"
    return f"--set {name}={rest}" if "." in name else f"--{name.replace('_', '-')} {rest}"
