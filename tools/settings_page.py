"""Writes docs/settings.md: every setting with its range, its value in each preset, and its comment, from config.py.

    python tools/settings_page.py

A test compares the page with what this makes, so that neither is changed without the other.
"""

import ast
import dataclasses
import re
import types
import typing
from pathlib import Path
from typing import Any

from compgs import config
from compgs.config import PRESETS, Range, load_config
from compgs.outputs import write_bytes
from compgs.training.plan import RULES

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "settings.md"

INTRODUCTION = """# Settings

Every setting of a training. Most runs need none of them: `--lmbda`, `--steps`, `--seed` and `--target-size` have
options of their own. `--set SECTION.NAME=VALUE` sets any other one, as often as needed. `compgs train --plan` prints
the values that a run would use.

- The value is that of the preset `default`. Another preset is named if its value differs.
- Schedules are shares of the run: 0.3 is 30 % of the steps.
- "Ref." marks values of the configuration that the paper's authors released.

`tools/settings_page.py` makes this page from `src/compgs/config.py`, where each setting has its range and its comment.
"""


def page() -> str:
    """The whole page."""
    source = Path(config.__file__).read_text(encoding="utf-8")
    presets = {name: load_config(name) for name in PRESETS}
    parts = [INTRODUCTION]
    for section in dataclasses.fields(config.Config):
        kind = type(getattr(presets["default"], section.name))
        parts.append(f"## {section.name}\n\n{summary(kind)}\n")
        parts.append(table(kind, comments_of(source, kind.__name__), section.name, presets))
    parts.append(rules())
    return "\n".join(parts)


RULES_INTRODUCTION = """## rules

A rule decides a value of the plan by facts that are known before the first step of a run
(`src/compgs/training/plan.py`): most replace a setting above, others a value that only the plan has.
`compgs train --plan` prints the decisions for a scene. `--set training.rules=none` applies no rule, as the `paper`
preset does. `--set training.rules='all but NAME, NAME'` leaves some out. For rules, a requested size counts as the
lambda that gives such files; for those of the grid, which comes before there are anchors, the setting counts.

| rule | decides | when | measured |
|---|---|---|---|
"""


def rules() -> str:
    """The table of the rules."""
    return RULES_INTRODUCTION + "".join(
        f"| `{rule.name}` | `{rule.sets}` | {rule.when} | [{Path(rule.evidence).stem}]({rule.evidence}) |\n"
        for rule in RULES
    )


def summary(kind: type) -> str:
    return (kind.__doc__ or "").strip().partition("\n")[0]


def table(kind: type, comments: dict[str, str], section: str, presets: dict[str, Any]) -> str:
    """Markdown of one section: a row for each setting."""
    lines = ["| setting | value | may be | meaning |", "|---|---|---|---|"]
    hints = typing.get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):  # type: ignore[arg-type]
        values = {name: getattr(getattr(preset, section), field.name) for name, preset in presets.items()}
        default = values.pop("default")
        others = [f"`{name}`: {shown_value(value)}" for name, value in values.items() if value != default]
        cells = [
            f"`{field.name}`",
            "; ".join([shown_value(default), *others]),
            allowed(hints[field.name]),
            comments.get(field.name, ""),
        ]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def comments_of(source: str, name: str) -> dict[str, str]:
    """Field -> the comment lines above it, joined, of the dataclass `name` in `source`."""
    lines = source.splitlines()
    found = {}
    tree = ast.parse(source)
    body = next(node.body for node in tree.body if isinstance(node, ast.ClassDef) and node.name == name)
    for node in body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            above = []
            at = node.lineno - 2
            while at >= 0 and lines[at].strip().startswith("#"):
                above.append(lines[at].strip().removeprefix("#").strip())
                at -= 1
            found[node.target.id] = " ".join(reversed(above))
    return found


def allowed(hint: Any) -> str:
    """In words: the range, or the choices, of a type."""
    if typing.get_origin(hint) is typing.Annotated:
        kind, *notes = typing.get_args(hint)
        ranges = [note for note in notes if isinstance(note, Range)]
        return "; ".join([*map(str, ranges), *(["or none"] if optional(kind) else []), *several(kind)])
    if typing.get_origin(hint) is typing.Literal:
        return ", ".join(f"`{choice}`" for choice in typing.get_args(hint))
    if hint is bool:
        return "true, false"
    if optional(hint):
        inner = [part for part in typing.get_args(hint) if part is not types.NoneType]
        return f"{allowed(inner[0])}; or none"
    return getattr(hint, "__name__", str(hint))


def optional(kind: Any) -> bool:
    return types.NoneType in typing.get_args(kind)


def several(kind: Any) -> list[str]:
    return ["several"] if typing.get_origin(kind) is tuple else []


def shown_value(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return ", ".join(shown_value(part) for part in value) or "none"
    if isinstance(value, float):
        return re.sub(r"e-0", "e-", f"{value:.4g}")
    return str(value)


if __name__ == "__main__":
    write_bytes(PAGE, page().encode())
