"""Docstrings are sentences that a stranger understands."""

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "tools"))
from docstrings import SOURCE, fragments, is_fragment  # noqa: E402


def test_no_docstring_of_the_package_only_continues_a_name() -> None:
    assert list(fragments(SOURCE)) == []


@pytest.mark.parametrize("text", ["Of the run, 0 to 1.", "As JSON has it.", "for a checkpoint.", "By name."])
def test_what_begins_with_a_preposition_is_a_fragment(text: str, tmp_path: Path) -> None:
    (tmp_path / "code.py").write_text(f'def progress():\n    """{text}"""\n', encoding="utf-8")
    (found,) = fragments(tmp_path)
    assert found.endswith(f"code.py:1 progress: {text}")


def test_the_text_of_an_option_is_looked_at_too(tmp_path: Path) -> None:
    code = 'class Command:\n    width: int = 320\n    """Of the images."""\n    height: int = 240\n    """Pixels."""\n'
    (tmp_path / "code.py").write_text(code, encoding="utf-8")
    (found,) = fragments(tmp_path)
    assert found.endswith("code.py:2 width: Of the images.")


@pytest.mark.parametrize(
    "text", ["Return the fraction of the run, 0 to 1.", "[N, 3] positions of the anchors.", ""]
)
def test_a_sentence_and_a_shape_are_none(text: str) -> None:
    assert not is_fragment(text)
