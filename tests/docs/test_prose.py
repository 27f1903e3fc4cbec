"""Pages that people read from top to bottom have no sentence that has to be read twice, as far as a tool can tell."""

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "tools"))
import prose  # noqa: E402


@pytest.mark.parametrize("page", prose.pages(), ids=lambda page: str(page.relative_to(ROOT)))
def test_a_page_has_no_sentence_that_hides_its_subject_or_has_more_than_35_words(page: Path) -> None:
    assert list(prose.listed(page)) == []


def test_long_sentences_and_hidden_subjects_are_found_in_paragraphs_and_lists_but_not_in_code(
    tmp_path: Path,
) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        f"# T\n\nA {'very ' * 40}long one. What is below is not drawn.\n\n- Two,\n  of which one.\n\n"
        "```\nwhat is code\n```\n\nWhat is this?\n",
        encoding="utf-8",
    )
    found = list(prose.listed(page))
    assert [line.split(": ")[1] for line in found] == [
        "43 words",
        "a clause as subject or object",
        "of which",
    ]
    assert [line.split(":")[1] for line in found] == ["3", "3", "5"]
