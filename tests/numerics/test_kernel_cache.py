"""Compiled kernels are found again, never when their sources changed, and nothing breaks where they cannot be kept."""

import ast
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numba
import pytest

import compgs
from compgs.numerics import kernel_cache
from compgs.numerics.compiled import njit

PACKAGE = Path(compgs.__file__).parent

# A kernel that inlines one of another file, which has a constant in it.
TRIAL = """
import sys
from types import SimpleNamespace
import numpy as np
from compgs.codec.binary_coder import HIGH, start_encoder
from compgs.numerics.compiled import njit

@njit
def upper_end(coder):
    start_encoder(coder)
    return coder[HIGH]

if __name__ == "__main__":
    print(upper_end(np.zeros(5, np.int64)), sum(upper_end.stats.cache_hits.values()))
"""


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a copy of the package, and a program that uses it."""
    folder = tmp_path_factory.mktemp("package")
    shutil.copytree(PACKAGE, folder / "compgs", ignore=shutil.ignore_patterns("__pycache__", "*.html"))
    (folder / "compgs" / "codec" / "trial.py").write_text(TRIAL)
    return folder


def start(package: Path, cache: Path, **environment: str) -> subprocess.Popen[str]:
    time.sleep(2 * kernel_cache.CLOCK_TICK)  # what was written just now is older than the process
    variables = {"PYTHONPATH": str(package), "NUMBA_CACHE_DIR": str(cache), **environment}
    command = [sys.executable, "-W", "error", "-m", "compgs.codec.trial"]
    return subprocess.Popen(command, env=os.environ | variables, text=True, stdout=subprocess.PIPE)


def finish(process: subprocess.Popen[str]) -> tuple[int, int]:
    """What the kernel returned, and whether it was found in the cache."""
    out, _ = process.communicate(timeout=120)
    assert process.returncode == 0
    value, hits = out.split()
    return int(value), int(hits)


@pytest.mark.slow
def test_an_edit_of_a_file_that_a_kernel_inlines_is_never_missed(package: Path, tmp_path: Path) -> None:
    assert finish(start(package, tmp_path)) == (2**48 - 1, 0)
    assert finish(start(package, tmp_path)) == (2**48 - 1, 1)
    inlined = package / "compgs" / "codec" / "binary_coder.py"
    before = inlined.read_text()
    inlined.write_text(before.replace("_MASK48 = (1 << 48) - 1", "_MASK48 = (1 << 47) - 1"))
    assert finish(start(package, tmp_path)) == (2**47 - 1, 0)
    inlined.write_text(before)
    assert finish(start(package, tmp_path)) == (2**48 - 1, 1), "both versions stay"


@pytest.mark.slow
def test_two_processes_may_compile_the_same_at_once(package: Path, tmp_path: Path) -> None:
    both = [start(package, tmp_path), start(package, tmp_path)]
    assert [finish(process)[0] for process in both] == [2**48 - 1, 2**48 - 1]
    assert finish(start(package, tmp_path)) == (2**48 - 1, 1)
    assert not list(tmp_path.rglob("*.tmp"))


@pytest.mark.slow
def test_kernels_work_where_nothing_can_be_written(package: Path, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    nowhere = str(file / "folder")
    variables = {"HOME": nowhere, "XDG_CACHE_HOME": nowhere, "LOCALAPPDATA": nowhere}
    blocked = f"import tempfile; tempfile.tempdir = {nowhere!r}"
    (package / "sitecustomize.py").write_text(blocked)
    try:
        assert finish(start(package, Path(nowhere), **variables)) == (2**48 - 1, 0)
    finally:
        (package / "sitecustomize.py").unlink()


# ---- which folder


@pytest.fixture
def places(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A folder that stands for a machine: nothing chosen, a home, temporary files."""
    for name in ("home", "temporary"):
        (tmp_path / name).mkdir()
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(kernel_cache, "writable_parent", kernel_cache.writable_parent.__wrapped__)
    return tmp_path


def block(place: Path) -> None:
    """Make a folder one that cannot be written, even by root."""
    place.rmdir()
    place.touch()


def test_the_folder_that_was_chosen_comes_first(places: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(places / "chosen"))
    assert kernel_cache.writable_parent() == places / "chosen" / "compgs-kernels"


def test_then_comes_the_users_cache(places: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert kernel_cache.writable_parent() == places / "home" / ".cache" / "compgs-kernels"
    monkeypatch.setenv("XDG_CACHE_HOME", str(places / "cache"))
    assert kernel_cache.writable_parent() == places / "cache" / "compgs-kernels"


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="users are told apart by the system's folders")
def test_then_a_temporary_folder_that_is_nobody_elses(places: Path) -> None:
    block(places / "home")
    folder = kernel_cache.writable_parent()
    assert folder == places / "temporary" / f"compgs-kernels-{os.getuid()}"
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o777)
    assert kernel_cache.writable_parent() is None, "others could have put kernels there"
    folder.rmdir()
    (places / "elsewhere").mkdir(mode=0o700)
    folder.symlink_to(places / "elsewhere")
    assert kernel_cache.writable_parent() is None, "others could have made the link"


def test_then_none(places: Path) -> None:
    block(places / "home")
    block(places / "temporary")
    assert kernel_cache.writable_parent() is None


def test_folders_of_old_versions_do_not_pile_up(tmp_path: Path) -> None:
    for age, version in enumerate("fedcba"):
        kernel_cache.make_folder(tmp_path / f"compgs.a-{version}")
        os.utime(tmp_path / f"compgs.a-{version}", (1e9 + age, 1e9 + age))
    kernel_cache.make_folder(tmp_path / "compgs.a.b-0")
    assert sorted(p.name for p in tmp_path.iterdir()) == [*(f"compgs.a-{v}" for v in "abcd"), "compgs.a.b-0"]
    kernel_cache.mark_used(tmp_path / "compgs.a-d")
    kernel_cache.make_folder(tmp_path / "compgs.a-g")
    assert sorted(p.name[-1] for p in tmp_path.glob("compgs.a-*")) == ["a", "b", "d", "g"]


# ---- which sources


def _parsed_imports(file: Path) -> set[str]:
    """Dotted names that Python's parser finds in the imports of a source."""
    found = set()
    for node in ast.walk(ast.parse(file.read_bytes())):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: a relative import is not looked up"
            found |= {node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found


def test_no_import_of_the_package_is_overlooked() -> None:
    for file in PACKAGE.rglob("*.py"):
        text = file.read_text(encoding="utf-8")
        names = [n.split(".") for n in _parsed_imports(file) if n.partition(".")[0] == "compgs"]
        places = [PACKAGE.joinpath(*name[1:]) for name in names]
        truth = {f for p in places for f in (p.with_suffix(".py"), p / "__init__.py") if f.is_file()}
        in_blocks = kernel_cache.FOR_THE_TYPE_CHECKER.findall(text)
        typing = set().union(*(kernel_cache.imported_files(block.partition("\n")[2]) for block in in_blocks))
        assert truth - typing <= kernel_cache.imported_files(text), file


def test_kernels_depend_on_what_they_import_and_on_nothing_else(package: Path) -> None:
    names = {str(p.relative_to(PACKAGE)) for p in kernel_cache.sources_of(PACKAGE / "codec" / "octree.py")}
    assert {"codec/octree.py", "codec/binary_coder.py", "numerics/compiled.py"} <= names
    assert not {name for name in names if name.startswith(("cli/", "training/", "viewer/"))}


def test_a_source_that_changed_while_the_process_ran_says_nothing_about_what_is_loaded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fingerprint = kernel_cache.fingerprint.__wrapped__
    assert fingerprint(PACKAGE / "codec" / "rans.py") is not None
    monkeypatch.setattr(compgs, "started", (PACKAGE / "codec" / "rans.py").stat().st_ctime - 1)
    assert fingerprint(PACKAGE / "codec" / "rans.py") is None


def test_versions_and_settings_of_the_compiler_are_part_of_the_fingerprint(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    file = PACKAGE / "codec" / "rans.py"
    monkeypatch.setattr(kernel_cache, "environment", kernel_cache.environment.__wrapped__)
    found = [kernel_cache.fingerprint.__wrapped__(file)]
    for target, value in (("numba.__version__", "0"), ("numba.config.BOUNDSCHECK", 1)):
        monkeypatch.setattr(target, value)
        found.append(kernel_cache.fingerprint.__wrapped__(file))
    assert len(set(found)) == 3


# ---- one kernel


def double(x):
    return 2 * x


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setattr(kernel_cache, "writable_parent", lambda: tmp_path)
    return tmp_path


def hits(kernel: numba.core.dispatcher.Dispatcher) -> int:
    return sum(kernel.stats.cache_hits.values())


def test_each_signature_is_kept_and_found_again(folder: Path) -> None:
    kernel = njit(double)
    assert (kernel(2), kernel(2.5), hits(kernel)) == (4, 5.0, 0)
    assert len(list(folder.rglob("*.kernel"))) == 2
    again = njit(double)
    assert (again(2), again(2.5), hits(again)) == (4, 5.0, 2)


def test_a_damaged_file_is_compiled_again(folder: Path) -> None:
    njit(double)(2)
    (file,) = folder.rglob("*.kernel")
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    kernel = njit(double)
    assert (kernel(3), hits(kernel)) == (6, 0)
    again = njit(double)
    assert (again(3), hits(again)) == (6, 1)


def test_a_folder_that_vanishes_and_a_full_disk_are_no_obstacles(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernel = njit(double)
    kernel(2)
    shutil.rmtree(next(folder.iterdir()))
    assert kernel(2.5) == 5.0

    def full(*args: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    assert njit(double)(2) == 4
