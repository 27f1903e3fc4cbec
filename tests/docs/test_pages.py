"""What the pages say of the code is there: files, names in them, packages; and summaries are whole sentences."""

import dataclasses
import importlib
import re
from pathlib import Path

import compgs
from compgs import config
from compgs.cli.main import COMMANDS
from compgs.viewer.page import html_page

ROOT = Path(__file__).resolve().parents[2]
SOURCE = Path(compgs.__file__).parent


def test_every_file_and_name_on_the_map_of_the_paper_exists() -> None:
    page = (ROOT / "docs" / "paper_map.md").read_text(encoding="utf-8")
    mentioned = re.findall(r"`([\w/]+\.(?:py|md))(?:: ([\w.]+))?`", page)
    assert len(mentioned) > 30
    for path, name in mentioned:
        found = next((root / path for root in (SOURCE, ROOT) if (root / path).is_file()), None)
        assert found is not None, path
        last = name.rpartition(".")[2]
        # A name is a class, a function, or an attribute that is assigned.
        assert not name or re.search(rf"\b(class|def) {last}\b|\b{last}\b.* = ", found.read_text()), (
            path,
            name,
        )


def test_every_package_stands_in_the_table_for_contributors() -> None:
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    told = re.findall(r"^\| `(\w+)` \|", page, flags=re.MULTILINE)
    there = [path.name for path in SOURCE.iterdir() if path.is_dir() and any(path.glob("*.py"))]
    assert sorted(told) == sorted(there)


def test_the_first_line_of_each_command_and_section_is_a_sentence() -> None:
    sections = [field.type for field in dataclasses.fields(config.Config)]
    for kind in (*COMMANDS, *sections):
        summary = (kind.__doc__ or "").partition("\n")[0]
        assert summary.endswith("."), (kind, summary)


def test_every_file_of_the_gallery_opens_and_makes_a_page() -> None:
    files = sorted((ROOT / "docs" / "gallery").glob("*.cgs"))
    page = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    assert files
    for file in files:
        assert compgs.decode(file).anchors > 100, "written by an older format? make it again"
        assert f"(gallery/{file.name})" in page and f'"gallery/{file.stem}.html"' in page
        assert len(html_page(file.read_bytes(), file.stem)) > file.stat().st_size


def test_every_setting_that_a_page_names_is_one_of_today() -> None:
    today = config.load_config("default").to_dict()
    sections = "|".join(name for name in today if isinstance(today[name], dict))
    named = re.compile(rf"`(?:--set )?({sections})\.([a-z_]+)[`=]")
    found = 0
    for page in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md")):
        for section, name in named.findall(page.read_text(encoding="utf-8")):
            assert name in today[section] or name == "json", f"{page.name}: {section}.{name}"
            found += 1
    assert found > 50


def test_the_reference_has_every_name_of_the_package_where_it_is_written() -> None:
    page = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    told = re.findall(r"^::: ([\w.]+)$", page, flags=re.MULTILINE)
    assert sorted(path.rpartition(".")[2] for path in told) == sorted(
        name for name in compgs.__all__ if name != "__version__"
    )
    for path in told:
        module, _, name = path.rpartition(".")
        found = getattr(importlib.import_module(module), name)
        given = getattr(importlib.import_module(compgs._HOME[name]), name)
        assert found is given and found.__module__ == module, path


def test_every_link_outside_of_the_site_leads_to_a_file() -> None:
    pages = [
        ROOT / name for name in ("README.md", "CONTRIBUTING.md", "conformance/README.md", "web/README.md")
    ]
    found = 0
    for page in pages:  # mkdocs checks the links within docs/
        text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
        for link in re.findall(r"\]\(([^)\s#]+)[^)]*\)", text):
            assert "://" in link or (page.parent / link).exists(), f"{page.relative_to(ROOT)}: {link}"
            found += 1
    assert found > 30
