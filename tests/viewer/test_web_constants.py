"""The constants of web/ are those of the document."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCUMENT = ROOT / "docs" / "bitstream.md"
SOURCE = ROOT / "web" / "src" / "codec" / "constants.ts"
# In the document, but not by name in web/: they belong to encoders, or are in the arithmetic itself.
OF_OTHERS = {
    "MAX_FILE_BYTES",
    "PRECISION_BITS",
    "SCALES_PER_OCTAVE",
    "SMALLEST_SCALE_OCTAVE",
    "INITIAL_STATE",
}


def value(expression: str) -> object:
    """Of a constant expression, which reads the same in Python."""
    tree = ast.parse(expression.strip(), mode="eval")
    assert not any(isinstance(node, ast.Name | ast.Call | ast.Attribute) for node in ast.walk(tree))
    return eval(compile(tree, "constants.ts", "eval"), {})


def test_constants_are_those_of_the_document() -> None:
    stated = dict(re.findall(r"^\| `([A-Z_0-9]+)` \| ([^|]+?) \|", DOCUMENT.read_text("utf-8"), re.MULTILINE))
    source = SOURCE.read_text("utf-8").replace(" as const;", ";")
    found = {
        name: value(text) for name, text in re.findall(r"^export const (\w+) = (.*);$", source, re.MULTILINE)
    }
    assert stated.keys() - found.keys() == OF_OTHERS
    for name in stated.keys() & found.keys():
        shown = stated[name].strip("` ")
        if name == "MAGIC":
            expected: object = list(bytes.fromhex(shown))
        elif "," in shown:
            expected = [int(number) for number in shown.split(",")]
        else:
            power = re.fullmatch(r"2\^(-?\d+)", shown)
            expected = 2.0 ** int(power[1]) if power else int(shown, 0)
        assert found[name] == expected, f"{name} is {found[name]}, the document says {shown}"
