"""Lists sentences of README.md and the pages of docs/ that have to be read twice.

    python tools/prose.py                      # counts, by page
    python tools/prose.py docs/tiles.md        # the sentences of these pages

A sentence is listed if it has more than 35 words, or a turn of phrase that hides its subject. docs/contribute.md shows
how to write instead. Code, tables and generated figures are passed over.
"""

import argparse
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LONGEST = 35  # words
HIDDEN = {
    "a clause as subject or object": r"\b[Ww]hat (?:is|are|was|were|has|have|comes?|lies?|costs?|differs?|follows?)\b",
    "of which": r"\b[Oo]f which\b",
    "as much as": r"\bas (?:much|many|little|few) as\b",
    "whatever": r"\b[Ww]hatever\b",
    "the former, the latter": r"\bthe (?:former|latter)\b",
    "in place of": r"\bin place of\b",
    "a fragment": r"^(?:Of|By which|From which|In which|Where|Which|And)\b(?![^.]*,)[^,]*$",
}


def pages() -> list[Path]:
    """Return README and all pages of the site."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def sentences(text: str) -> Iterator[tuple[int, str]]:
    """Yield (line, sentence) of a page: of paragraphs and of items of lists."""
    text = _blanked(r"^```.*?^```", text)
    text = _blanked(r"<!-- figures: .*?<!-- end of figures -->", text)
    paragraph: list[str] = []
    begun = 0
    for number, line in enumerate([*text.splitlines(), ""], 1):
        item = re.match(r"\s*(?:[-*]|\d+\.) ", line)
        table = line.lstrip().startswith("|")
        other = table or not line.strip() or line.startswith(("#", "!", ":::", "    ", "<", "---"))
        if paragraph and (other or item):
            yield from ((begun, sentence) for sentence in _split(" ".join(paragraph)))
            paragraph = []
        if not other or (item and line.strip()):
            begun = begun if paragraph else number
            paragraph.append(re.sub(r"^\s*(?:[-*]|\d+\.) ", "", line).strip())


def faults(sentence: str) -> list[str]:
    """Return what makes a sentence hard to read."""
    words = sentence.split()
    found = [f"{len(words)} words"] if len(words) > LONGEST else []
    question = sentence.rstrip().endswith("?")
    return found + [name for name, pattern in HIDDEN.items() if re.search(pattern, sentence) and not question]


def listed(page: Path) -> Iterator[str]:
    """Yield `page:line: faults: sentence` of one page."""
    for line, sentence in sentences(page.read_text(encoding="utf-8")):
        if found := faults(sentence):
            yield f"{page.name}:{line}: {', '.join(found)}: {sentence}"


def _blanked(pattern: str, text: str) -> str:
    """Return the text with as many empty lines in the place of what the pattern finds."""
    return re.sub(pattern, lambda found: "\n" * found[0].count("\n"), text, flags=re.DOTALL | re.MULTILINE)


def _split(paragraph: str) -> list[str]:
    plain = re.sub(r"`[^`]*`", "CODE", paragraph)
    plain = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", plain).replace("**", "").replace("*", "")
    return [part for part in re.split(r"(?<=[.!?:])\s+(?=[A-Z\"(])", plain) if part]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("pages", type=Path, nargs="*")
    chosen = parser.parse_args().pages
    for page in chosen or pages():
        found = list(listed(page))
        print("\n".join(found) if chosen else f"{len(found):4} {page.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
