"""web/ in Node: the same integers and Gaussians as here, and the page that the package ships."""

import json
import os
import sys
from pathlib import Path

import pytest

import compgs

from .conftest import WEB, run

PAGE = Path(compgs.__file__).parent / "viewer" / "page.html"


def test_the_shipped_page_is_the_one_that_web_builds(built: Path) -> None:
    assert (built / "page.html").read_bytes() == PAGE.read_bytes(), "run make web, and commit page.html"


@pytest.mark.slow
def test_style_and_types_hold(node: str) -> None:
    run([node, "node_modules/typescript/bin/tsc", "--noEmit"])
    run([node, "node_modules/prettier/bin/prettier.cjs", "--check", "."])


@pytest.mark.slow
def test_a_browser_decodes_the_same_integers_and_gaussians(node: str, built: Path, tmp_path: Path) -> None:
    path = os.pathsep.join(filter(None, (str(PAGE.parents[2]), os.environ.get("PYTHONPATH"))))
    run([sys.executable, "test/make_fixtures.py", str(tmp_path)], PYTHONPATH=path)
    tests = sorted(str(file) for file in WEB.glob("test/*.test.mjs"))
    output = run([node, "--test", *tests], CGS_BUILD=str(built), CGS_FIXTURES=str(tmp_path))
    assert "# fail 0" in output and "# skipped 0" in output


def test_the_lock_file_names_no_host() -> None:
    lock = json.loads((WEB / "package-lock.json").read_text(encoding="utf-8"))
    assert not any("resolved" in package for package in lock["packages"].values())
    assert all("integrity" in package for name, package in lock["packages"].items() if name)


def test_the_decoder_for_the_web_conforms(node: str, built: Path) -> None:
    """It draws with a browser's help alone, so that pictures are not asked for."""
    judge = WEB.parent / "conformance"
    command = [node, str(judge / "decoders" / "web.mjs")]
    output = run([sys.executable, str(judge / "run.py"), *command], CGS_BUILD=str(built))
    assert output.endswith("conforms\n")
