"""Sizes of files, times and other counts as people type them."""

import re

from compgs.cli.usage import UsageError
from compgs.config import MAX_VIEWPOINTS

UNITS = {"": 1, "b": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9, "kib": 1 << 10, "mib": 1 << 20, "gib": 1 << 30}

AUTO = "auto"  # of `-r`

SECONDS = {"": 1, "s": 1, "sec": 1, "m": 60, "min": 60, "h": 3600}


def parse_time(text: str, option: str) -> float:
    """Seconds of `5min`, `90s`, `1.5h`, `1h30min` or `300`. Raises UsageError that names the option."""
    parts = re.findall(r"(\d+(?:\.\d*)?|\.\d+)\s*([A-Za-z]*)\s*", text)
    whole = re.fullmatch(r"\s*(?:(?:\d+(?:\.\d*)?|\.\d+)\s*[A-Za-z]*\s*)+", text)
    if whole is None or any(unit.lower() not in SECONDS for _, unit in parts):
        raise UsageError(f"{option} {text}: expected a time such as 5min, 90s, 1.5h or 1h30min")
    seconds = sum(float(count) * SECONDS[unit.lower()] for count, unit in parts)
    if not seconds > 0:
        raise UsageError(f"{option} {text}: expected more than no time")
    return seconds


def check_one_of_time_and_steps(time: str | None, steps: int | None) -> None:
    """Raises UsageError for a time and steps together."""
    if time is not None and steps is not None:
        raise UsageError("--time chooses the steps, and --steps gives them; give one of them")


def parse_size(text: str, option: str) -> int:
    """Bytes of `130kB`, `2 MB`, `1.5MiB` or `130000`; a kB is 1000 bytes. Raises UsageError that names the option."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([A-Za-z]*)\s*", text)
    if match is None or match[2].lower() not in UNITS:
        raise UsageError(
            f"{option} {text}: expected a size such as 130kB, 2MB, 1.5MiB or plain bytes; "
            "units are B, kB, MB, GB (powers of 1000) and KiB, MiB, GiB"
        )
    count = round(float(match[1]) * UNITS[match[2].lower()])
    if count < 1:
        raise UsageError(f"{option} {text}: expected at least one byte")
    return count


def parse_downscale(text: str) -> int | str:
    """`4`, or `auto`. Raises UsageError."""
    if text.strip().lower() == AUTO:
        return AUTO
    try:
        return int(text)
    except ValueError:
        raise UsageError(f"-r: expected a whole number or {AUTO}, found {text!r}") from None


def parse_cameras(text: str) -> int:
    """`12`, or `none`. Raises UsageError."""
    if text.strip().lower() == "none":
        return 0
    if not text.strip().isdigit() or int(text) > MAX_VIEWPOINTS:
        raise UsageError(f"--cameras {text}: expected 0 to {MAX_VIEWPOINTS}, or none")
    return int(text)
