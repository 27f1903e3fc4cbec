"""Tables say the same in every form, and what is special to a form does not break it."""

import csv
import io
import re

import pytest

from compgs.evaluation.reports.tables import (
    Column,
    Spread,
    Table,
    escape_latex,
    shown,
    to_csv,
    to_html,
    to_latex,
    to_markdown,
)

from .parsed_page import ParsedPage

ODD = 'a_b & 50% of $x | <i>"é", \\{#1}~^'
TABLE = Table(
    "results",
    "Results of 50%",
    (Column("scene", "scene"), Column("psnr", "PSNR, dB", ".2f"), Column("bytes", "bytes", ",.0f")),
    (
        (ODD, Spread(28.315501010593, 0.125), 56819),
        ("two, three\nlines", float("inf"), None),
        ("third", 1 / 3, Spread(1e6, None)),
    ),
    ("A note_1.",),
)


def test_csv_is_read_back_with_every_digit() -> None:
    rows = list(csv.DictReader(io.StringIO(to_csv(TABLE), newline="")))
    assert list(rows[0]) == ["scene", "psnr", "psnr_spread", "bytes"]
    assert [row["scene"] for row in rows] == [ODD, "two, three\nlines", "third"]
    assert [float(row["psnr"]) for row in rows] == [28.315501010593, float("inf"), 1 / 3]
    assert [row["psnr_spread"] for row in rows] == ["0.125", "", ""]
    assert [row["bytes"] for row in rows] == ["56819", "", "1000000.0"]


def test_markdown_keeps_its_columns_whatever_is_in_a_cell() -> None:
    lines = [line for line in to_markdown(TABLE).splitlines() if line.startswith("|")]
    assert len(lines) == 5
    cells = [re.split(r"(?<!\\)\|", line)[1:-1] for line in lines]
    assert {len(row) for row in cells} == {3}
    assert cells[1] == ["---", "---:", "---:"]
    assert [cell.strip() for cell in cells[2][1:]] == ["28.32 ± 0.12", "56,819"]
    assert [cell.strip() for cell in cells[3]] == ["two, three lines", "identical", "–"]
    assert "\\<i>" in lines[2]


def test_html_is_text_and_numbers_are_aligned() -> None:
    page = ParsedPage(to_html(TABLE).encode())
    assert page.tables["results"] == [
        ["scene", "PSNR, dB", "bytes"],
        [ODD, "28.32 ± 0.12", "56,819"],
        ["two, three\nlines", "identical", "–"],
        ["third", "0.33", "1,000,000"],
    ]
    assert "i" not in page.tags and "A note_1." in page.text
    assert to_html(TABLE).count('<td class="n">') == 6


def unescaped(text: str) -> str:
    """What LaTeX sets: the inverse of `escape_latex`, by another way."""
    words = {
        "textbackslash": "\\", "textasciitilde": "~", "textasciicircum": "^", "textless": "<",
        "textgreater": ">", "textbar": "|",
    }  # fmt: skip
    text = text.replace(r"$\pm$", "±").replace(r"$\times$", "×").replace("$-$", "-")
    text = re.sub(r"\\(text[a-z]+)\{\}", lambda match: f"\0{ord(words[match[1]])}\0", text)
    text = re.sub(r"\\([&%$#_{}])", r"\1", text)
    return re.sub("\0(\\d+)\0", lambda match: chr(int(match[1])), text)


@pytest.mark.parametrize("text", [ODD, "28.32 ± 0.12", "-23.4%", "2 × 3", "a-b", "\\textbar{}", "plain"])
def test_latex_sets_what_was_meant(text: str) -> None:
    escaped = escape_latex(text)
    assert unescaped(escaped) == text
    bare = re.sub(r"\\(text[a-z]+\{\}|[&%$#_{}])|\$(\\pm|\\times|-)\$", "", escaped)
    assert not re.search(r"[&%$#_{}~^\\<>|]", bare)


def test_a_latex_table_has_one_cell_for_each_column() -> None:
    lines = to_latex(TABLE).splitlines()
    assert r"\begin{tabular}{lrr}" in lines[3]
    rows = [line for line in lines if line.endswith(r"\\")]
    assert len(rows) == 4
    assert all(len(re.findall(r"(?<!\\)&", row)) == 2 for row in rows)
    assert r"\caption{Results of 50\%. A note\_1.}" in lines[1] and r"\label{tab:results}" in lines[2]
    assert rows[1].endswith(r"28.32 $\pm$ 0.12 & 56,819 \\")


def test_shares_keep_their_sign() -> None:
    assert shown(-0.2341, "+.1%") == "-23.4%" and shown(0.05, "+.1%") == "+5.0%"
    assert shown(Spread(0.05, 0.01), "+.1%") == "+5.0% ± 1.0%"
    assert shown(float("nan"), ".2f") == "–"


def test_columns_of_which_nothing_is_known_are_left_out() -> None:
    columns = (Column("a", "a"), Column("b", "b", ".1f"), Column("c", "c", ".1f"))
    table = Table("t", "T", columns, (("x", None, 1), ("y", None, None))).without_empty_columns()
    assert [column.key for column in table.columns] == ["a", "c"]
    assert table.rows == (("x", 1), ("y", None))
