"""What is installed: the wheel has the files of the package and no others, says what it is, and works elsewhere."""

import email
import importlib.metadata
import os
import re
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from email.message import Message
from pathlib import Path

import pytest

import compgs

ROOT = Path(__file__).resolve().parent.parent
GOLDEN = ROOT / "tests" / "golden"
pytestmark = pytest.mark.slow
pytest.importorskip("build", reason="needs the extra `dev`")


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A source archive, and the wheel that is built from it: as a packager does."""
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=600)
    assert done.returncode == 0, done.stdout[-4000:]
    return folder


@pytest.fixture(scope="module")
def wheel(dist: Path) -> Path:
    (found,) = dist.glob("*.whl")
    return found


def metadata_of(wheel: Path) -> Message:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (each for each in archive.namelist() if each.endswith(".dist-info/METADATA"))
        return email.message_from_bytes(archive.read(name))


def package_files() -> set[str]:
    """Files of the package that are kept in the repository."""
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "src/compgs"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    if listed.returncode:
        pytest.skip("not a checkout of git")
    return {line.removeprefix("src/") for line in listed.stdout.splitlines() if (ROOT / line).is_file()}


def test_the_wheel_has_the_files_of_the_package_and_no_others(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
        assert names == package_files()
        for name in names:
            assert archive.read(name) == (ROOT / "src" / name).read_bytes(), name
    for needed in ("viewer/page.html", "codec/gaussian_tables.bin", "presets/default.toml", "py.typed"):
        assert f"compgs/{needed}" in names


def test_the_metadata_say_license_pythons_requirements_and_commands(wheel: Path) -> None:
    metadata = metadata_of(wheel)
    assert metadata["Name"] == "compgs" and metadata["Version"] == compgs.__version__
    assert metadata["License-Expression"] == "Apache-2.0" and metadata["License-File"] == "LICENSE"
    assert metadata["Requires-Python"] == ">=3.11"
    pythons = {c.rpartition(" ")[2] for c in metadata.get_all("Classifier", []) if "Python :: 3." in c}
    assert {"3.11", "3.12", "3.13"} <= pythons
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert set(metadata.get_all("Provides-Extra", [])) == set(project["optional-dependencies"])
    needed = [r for r in metadata.get_all("Requires-Dist", []) if "extra ==" not in r]
    assert {re.split("[<>=]", r)[0] for r in needed} == {"numpy", "numba", "pillow", "tyro", "rich"}
    assert metadata["Description-Content-Type"] == "text/markdown"
    assert "Photographs go in" in str(metadata.get_payload())
    with zipfile.ZipFile(wheel) as archive:
        (entries,) = (each for each in archive.namelist() if each.endswith("entry_points.txt"))
        assert archive.read(entries).decode().split() == [
            "[console_scripts]",
            "compgs",
            "=",
            "compgs.cli.main:main",
        ]
        (text,) = (each for each in archive.namelist() if each.endswith("licenses/LICENSE"))
        assert archive.read(text) == (ROOT / "LICENSE").read_bytes()


def test_the_source_archive_has_what_builds_and_tests_the_package(dist: Path) -> None:
    (archive,) = dist.glob("*.tar.gz")
    with tarfile.open(archive) as content:
        names = {name.partition("/")[2] for name in content.getnames()}
    wanted = ("pyproject.toml", "LICENSE", "tests/golden/trained.cgs", "web/build.mjs", "c/compgs.h")
    for needed in (*wanted, "docs/bitstream.md", *(f"src/{name}" for name in package_files())):
        assert needed in names, needed
    assert not [name for name in names if re.search(r"node_modules|__pycache__|\.nb[ci]$|\.venv", name)]
    assert archive.stat().st_size < 8_000_000


def needed(requirements: list[str]) -> set[str]:
    """Names of the distributions that these requirements bring, without extras."""
    from packaging.requirements import Requirement

    found: set[str] = set()
    for requirement in map(Requirement, requirements):
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            found |= {requirement.name, *needed(importlib.metadata.requires(requirement.name) or [])}
    return found


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a new environment's programs: the wheel is in it, and what it needs is borrowed from this one."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=True)
    programs = next(path for path in (folder / "bin", folder / "Scripts") if path.is_dir())
    (site,) = [*folder.glob("lib/python*/site-packages"), *folder.glob("Lib/site-packages")]
    python = str(programs / "python")
    pip = [
        python,
        "-m",
        "pip",
        "--quiet",
        "--disable-pip-version-check",
        "install",
        "--no-index",
        "--no-deps",
    ]
    subprocess.run([*pip, str(wheel)], check=True)
    for name in needed(metadata_of(wheel).get_all("Requires-Dist", [])):
        distribution = importlib.metadata.distribution(name)
        for part in {file.parts[0] for file in distribution.files or ()} - {"..", "__pycache__"}:
            link = site / part
            if not link.exists():
                link.symlink_to(Path(str(distribution.locate_file(part))))
    return programs


def test_the_installed_package_does_what_somebody_does_who_has_received_a_file(
    installed: Path, tmp_path: Path
) -> None:
    def run(*command: object) -> str:
        done = subprocess.run(
            [str(part) for part in command],
            cwd=tmp_path,
            env={name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
            capture_output=True,
            text=True,
            timeout=900,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    python = installed / "python"
    where = Path(run(python, "-c", "import compgs; print(compgs.__file__)").strip())
    assert where.is_relative_to(installed.parent)
    assert compgs.__version__ in run(installed / "compgs", "--version")
    assert "usage: compgs" in run(installed / "compgs", "--help")
    # info, decode, render, encode, export to every format and to a page, compare; and no torch is loaded.
    out = run(python, ROOT / "tools" / "check_light.py", GOLDEN / "trained.cgs", tmp_path / "out")
    assert "all of it works" in out
    page = (tmp_path / "out" / "a.html").read_bytes()
    template = (ROOT / "src" / "compgs" / "viewer" / "page.html").read_bytes()
    assert page[:100] == template[:100] and len(page) > len(template)
