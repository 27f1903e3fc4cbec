"""A package with a table of its files names all of them, and no other."""

import ast
import re
from pathlib import Path

import pytest

import compgs

SOURCE = Path(compgs.__file__).parent
TABLED = (
    "codec",
    "evaluation",
    "entropy",
    "numerics",
    "scene",
    "training",
    "training/step",
    "training/shortcuts",
    "training/structure",
    "training/rate",
    "training/run",
    "training/splats",
    "published",
    "published/parts",
    "methods/parts",
)


@pytest.mark.parametrize("room", TABLED)
def test_the_table_of_a_package_names_its_files(room: str) -> None:
    folder = SOURCE / room
    text = ast.get_docstring(ast.parse((folder / "__init__.py").read_text(encoding="utf-8"))) or ""
    cells = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    named = {name.rstrip("/") for cell in cells for name in re.findall(r"`([^`]+)`", cell)}
    files = {path.stem for path in folder.glob("*.py")} - {"__init__"}
    folders = {path.parent.name for path in folder.glob("*/__init__.py")}
    assert named == files | folders
