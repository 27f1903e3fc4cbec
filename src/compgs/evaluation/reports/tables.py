"""Tables: one structure, written as CSV for programs, as Markdown, LaTeX and HTML for people.

CSV has every digit and the names of `Column.key`; a column with spreads gets a second one, `key_spread`. The others
have what `Column.form` leaves of a number.
"""

import csv
import html
import io
import math
from dataclasses import dataclass

MISSING = "–"  # where people would see nothing
IDENTICAL = "identical"  # what an infinite PSNR is


@dataclass(frozen=True)
class Spread:
    """A number over several seeds."""

    mean: float
    deviation: float | None  # standard deviation of the sample; None of a single one


Value = str | int | float | Spread | None


@dataclass(frozen=True)
class Column:
    key: str  # for programs
    title: str  # for people, with the unit
    form: str = ""  # of numbers, as in format(); "+.1%" of shares


@dataclass(frozen=True)
class Table:
    """Rows of values; the first `Column`s without a form are names."""

    key: str  # for programs, and in the names of files
    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Value, ...], ...]
    notes: tuple[str, ...] = ()  # below the table

    def __post_init__(self) -> None:
        assert all(len(row) == len(self.columns) for row in self.rows), self.key

    def records(self) -> list[dict[str, Value]]:
        """The rows by the columns' keys."""
        keys = [column.key for column in self.columns]
        return [dict(zip(keys, row, strict=True)) for row in self.rows]

    def without_empty_columns(self) -> "Table":
        """Leave out columns in which nothing is known."""
        kept = [i for i in range(len(self.columns)) if any(row[i] is not None for row in self.rows)]
        columns = tuple(self.columns[i] for i in kept)
        return Table(
            self.key, self.title, columns, tuple(tuple(row[i] for i in kept) for row in self.rows), self.notes
        )


def shown(value: Value, form: str) -> str:
    """A value for people; of several seeds `28.32 ± 0.05`."""
    if value is None:
        return MISSING
    if isinstance(value, str):
        return value
    if isinstance(value, Spread):
        around = "" if value.deviation is None else f" ± {format(value.deviation, form.lstrip('+'))}"
        return shown(value.mean, form) + around
    if math.isnan(value):
        return MISSING
    return IDENTICAL if math.isinf(value) else format(value, form)


def to_csv(table: Table) -> str:
    """RFC 4180, numbers as Python writes them: what is read back is equal."""
    spread = [any(_deviation(row[i]) is not None for row in table.rows) for i in range(len(table.columns))]
    text = io.StringIO()
    writer = csv.writer(text)
    head: list[str] = []
    for column, has_spread in zip(table.columns, spread, strict=True):
        head += [column.key, f"{column.key}_spread"] if has_spread else [column.key]
    writer.writerow(head)
    for row in table.rows:
        cells: list[object] = []
        for value, has_spread in zip(row, spread, strict=True):
            mean = value.mean if isinstance(value, Spread) else value
            cells.append("" if mean is None else mean)
            if has_spread:
                deviation = _deviation(value)
                cells.append("" if deviation is None else deviation)
        writer.writerow(cells)
    return text.getvalue()


def to_markdown(table: Table) -> str:
    """Return the table as Markdown, with the title as a heading."""
    head = [_for_markdown(column.title) for column in table.columns]
    rule = ["---:" if column.form else "---" for column in table.columns]
    lines = [f"## {_for_markdown(table.title)}", ""]
    lines += ["| " + " | ".join(head) + " |", "|" + "|".join(rule) + "|"]
    lines += ["| " + " | ".join(map(_for_markdown, cells)) + " |" for cells in _shown_rows(table)]
    lines += ["", *(f"{_for_markdown(note)}\n" for note in table.notes)]
    return "\n".join(lines)


def to_latex(table: Table) -> str:
    r"""A `table` of the package booktabs, with the key as its label: `\ref{tab:results}`."""
    columns = "".join("r" if column.form else "l" for column in table.columns)
    lines = [
        r"\begin{table}",
        rf"  \caption{{{escape_latex('. '.join([table.title, *table.notes]))}}}",
        rf"  \label{{tab:{table.key.replace('_', '-')}}}",
        rf"  \begin{{tabular}}{{{columns}}}",
        r"    \toprule",
        "    " + " & ".join(escape_latex(column.title) for column in table.columns) + r" \\",
        r"    \midrule",
        *("    " + " & ".join(map(escape_latex, cells)) + r" \\" for cells in _shown_rows(table)),
        r"    \bottomrule",
        r"  \end{tabular}",
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


def to_html(table: Table) -> str:
    """A `<table>` with its notes; cells of columns with numbers have the class `n`."""
    head = "".join(
        f'<th{_class(column)} scope="col">{html.escape(column.title)}</th>' for column in table.columns
    )
    rows = "".join(
        "<tr>"
        + "".join(
            f"<td{_class(column)}>{html.escape(cell)}</td>"
            for cell, column in zip(cells, table.columns, strict=True)
        )
        + "</tr>\n"
        for cells in _shown_rows(table)
    )
    notes = "".join(f'<p class="note">{html.escape(note)}</p>\n' for note in table.notes)
    return (
        f'<div class="wide"><table id="{html.escape(table.key)}">\n<thead><tr>{head}</tr></thead>\n'
        f"<tbody>\n{rows}</tbody></table></div>\n{notes}"
    )


LATEX = {
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "±": r"$\pm$",
    "×": r"$\times$",
    "–": "--",
    "\n": " ",
}


def escape_latex(text: str) -> str:
    """Text that LaTeX sets as it stands; the minus of a number as a minus."""
    escaped = "".join(LATEX.get(letter, letter) for letter in text)
    return f"$-${escaped[1:]}" if text[:1] == "-" and text[1:2].isdigit() else escaped


def _shown_rows(table: Table) -> list[list[str]]:
    forms = [column.form for column in table.columns]
    return [[shown(value, form) for value, form in zip(row, forms, strict=True)] for row in table.rows]


def _deviation(value: Value) -> float | None:
    return value.deviation if isinstance(value, Spread) else None


def _class(column: Column) -> str:
    return ' class="n"' if column.form else ""


def _for_markdown(text: str) -> str:
    escaped = "".join(f"\\{letter}" if letter in "\\|*`<" else letter for letter in text)
    return escaped.replace("\n", " ")
