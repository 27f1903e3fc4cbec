"""Counts docstrings, and texts of options, that are fragments: they only continue the name above them ("Of the run.").

    python tools/docstrings.py

A docstring that begins with a preposition cannot be read without the name and the code around it. Begin with a verb, or
with the thing that is meant.
"""

import ast
import itertools
from collections.abc import Iterator
from pathlib import Path

SOURCE = Path(__file__).resolve().parents[1] / "src" / "compgs"
PREPOSITIONS = frozenset({
    "after", "as", "at", "before", "beside", "between", "by", "for", "from", "in", "of", "on", "over", "per", "through",
    "to", "under", "until", "with", "without",
})  # fmt: skip


def fragments(folder: Path) -> Iterator[str]:
    """Yield `file:line name: docstring` for every fragment in a folder."""
    for file in sorted(folder.rglob("*.py")):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        for line, name, text in sorted((*docstrings(tree), *options(tree))):
            if is_fragment(text):
                yield f"{file}:{line} {name}: {text.splitlines()[0]}"


def docstrings(tree: ast.Module) -> Iterator[tuple[int, str, str]]:
    """Yield line, name and docstring of each function and class."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.lineno, node.name, ast.get_docstring(node) or ""


def options(tree: ast.Module) -> Iterator[tuple[int, str, str]]:
    """Yield the same of each field with a text below it, as the help of the command line shows it."""
    for node in ast.walk(tree):
        for field, below in itertools.pairwise(node.body) if isinstance(node, ast.ClassDef) else ():
            if (
                isinstance(field, ast.AnnAssign)
                and isinstance(field.target, ast.Name)
                and isinstance(below, ast.Expr)
                and isinstance(below.value, ast.Constant)
                and isinstance(below.value.value, str)
            ):
                yield field.lineno, field.target.id, below.value.value


def is_fragment(text: str) -> bool:
    """Return whether a docstring begins with a preposition."""
    words = text.split(maxsplit=1)
    return bool(words) and words[0].lower().strip(",:;.") in PREPOSITIONS


def main() -> None:
    found = list(fragments(SOURCE))
    print("\n".join([*found, f"{len(found)} fragments"]))


if __name__ == "__main__":
    main()
