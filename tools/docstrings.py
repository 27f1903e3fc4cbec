"""Counts docstrings that are fragments: those that only continue the name above them ("Of the run, 0 to 1.").

    python tools/docstrings.py

A docstring that begins with a preposition cannot be read without the name and the code around it. Begin with a verb, or
with the thing that is meant.
"""

import ast
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
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                continue
            text = ast.get_docstring(node)
            if text and is_fragment(text):
                yield f"{file}:{node.lineno} {node.name}: {text.splitlines()[0]}"


def is_fragment(text: str) -> bool:
    """Return whether a docstring begins with a preposition."""
    words = text.split(maxsplit=1)
    return bool(words) and words[0].lower().strip(",:;.") in PREPOSITIONS


def main() -> None:
    found = list(fragments(SOURCE))
    print("\n".join([*found, f"{len(found)} fragments"]))


if __name__ == "__main__":
    main()
