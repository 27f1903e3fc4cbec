"""Where compiled kernels are kept between processes, and when they are still those of the source.

numba compares the source file of a kernel only. A kernel contains what it calls, and the constants of the files
it imports: after an edit, or an upgrade, of one of these, numba would run the old machine code. Here the kernels of
a module lie in a folder of their own, whose name holds a hash of everything that decides their machine code:

    <parent>/compgs-kernels/compgs.codec.octree-5c0e.../decode-247.1f3a....kernel

the source of the module and of all modules of the package that it imports, directly or not; the versions of Python,
numba, llvmlite and numpy; and numba's settings. Signature and processor are in the name of the file.

The parent is NUMBA_CACHE_DIR where it is set, else the user's cache folder; where that cannot be written (a container,
a service, a read-only home), a folder of this user alone among the temporary files; and if that is impossible too,
kernels are compiled anew in each process. The folders of the FOLDERS_KEPT latest versions of a module stay, older ones
are removed when a new one is made.

Several processes may share a folder: a file is written under another name and renamed, holds one kernel, and
replaces at worst the same kernel. Who begins to compile a kernel locks it (where the system has such locks); others
wait and take it from the cache. What is damaged, or vanishes, is compiled again.
"""

import functools
import hashlib
import os
import pickle
import platform
import re
import shutil
import stat
import sys
import tempfile
import time
from pathlib import Path
from types import FunctionType
from typing import Any, BinaryIO
from uuid import uuid4

import llvmlite
import numba
import numpy
from numba.core import caching

import compgs

try:
    import fcntl
except ImportError:  # Windows: two processes may compile the same
    fcntl = None  # type: ignore[assignment]

PACKAGE = Path(compgs.__file__).resolve().parent
FOLDER = "compgs-kernels"
FOLDERS_KEPT = 4  # of a module: as many versions of the package may take turns without compiling again
TOUCH_SECONDS = 86_400  # a folder in use is marked as used once a day

# Settings of numba that change the machine code, but not numba's name for it.
SETTINGS = ("OPT", "BOUNDSCHECK", "LOOP_VECTORIZE", "SLP_VECTORIZE", "ENABLE_AVX", "DEBUGINFO_DEFAULT")

# `from compgs.codec import a, b` or `import compgs.codec.a`, at the start of a line, the names perhaps in brackets.
IMPORT = re.compile(
    r"^[ \t]*(?:from|import)[ \t]+(compgs[\w.]*)(?:[ \t]+import[ \t]+(\([^)]*\)|.*))?", re.MULTILINE
)
FOR_THE_TYPE_CHECKER = re.compile(r"^if TYPE_CHECKING:\n(?:(?:[ \t].*)?\n)*", re.MULTILINE)

# Seconds by which a file system's clock may lag behind the system's.
CLOCK_TICK = 0.02


class KernelCache(caching.FunctionCache):
    """The compiled versions of one function, one for each signature and processor."""

    _impl_class: Any
    _cache_file: Any

    def __init__(self, function: FunctionType, folder: Path) -> None:
        self._impl_class = functools.partial(_Kernels, folder=folder)
        super().__init__(function)
        self._cache_file = _KernelFiles(folder, self._impl.filename_base)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """A kernel from the cache; one that another process is compiling, when it has done so. None: the caller is to
        compile it, and others wait."""
        key = self._index_key(sig, target_context.codegen())
        kernel = super().load_overload(sig, target_context)
        if kernel is None and self._cache_file.begin(key):
            kernel = super().load_overload(sig, target_context)
            if kernel is not None:
                self._cache_file.end(key)
        return kernel

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled kernel, if that is possible: a full disk is no reason to stop."""
        try:
            super().save_overload(sig, data)
        except OSError:
            self.disable()
        finally:
            self._cache_file.end(self._index_key(sig, data.codegen))

    def is_being_compiled(self, sig: Any, target_context: Any) -> bool:
        """Whether a kernel is compiled by another process right now."""
        return self._cache_file.is_locked(self._index_key(sig, target_context.codegen()))


class _Kernels(caching.CompileResultCacheImpl):
    """How a compiled function becomes bytes: numba's way, under names of ours."""

    def __init__(self, function: FunctionType, folder: Path) -> None:
        self._lineno = function.__code__.co_firstlineno
        self._locator = _Folder(folder)
        self._filename_base = f"{function.__qualname__.replace('<', '').replace('>', '')}-{self._lineno}"


class _Folder(caching._CacheLocator):
    """A folder that needs no stamp: its name says which sources it belongs to."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._py_file = str(folder)  # for numba's warnings

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return self._folder.name

    def get_disambiguator(self) -> str:
        return ""


class _KernelFiles:
    """One file for each signature and processor. (numba keeps an index of numbered files: two processes that add to
    it at once may each write a number 1.)"""

    def __init__(self, folder: Path, name: str) -> None:
        self.folder = folder
        self.name = name
        self._held: dict[Path, BinaryIO] = {}  # locks on what this process is compiling

    def path(self, key: Any) -> Path:
        return self.folder / f"{self.name}.{_digest(repr(key).encode())[:16]}.kernel"

    def load(self, key: Any) -> Any:
        """What was saved under this key; None if there is nothing, or nothing usable."""
        try:
            saved_key, data = pickle.loads(self.path(key).read_bytes())
        except Exception:
            return None
        return data if saved_key == repr(key) else None

    def save(self, key: Any, data: Any) -> None:
        """Raises OSError."""
        target = self.path(key)
        if not self.folder.is_dir():
            make_folder(self.folder)
        temporary = target.with_name(f"{target.name}.{uuid4().hex[:16]}.tmp")
        try:
            temporary.write_bytes(caching.dumps((repr(key), data)))
            temporary.replace(target)
        finally:
            temporary.unlink(missing_ok=True)

    def begin(self, key: Any) -> bool:
        """Hold the lock of a kernel. True if another process held it meanwhile: the kernel may be there now."""
        place = self.path(key)
        if fcntl is None or place in self._held:
            return False  # an earlier attempt to compile it failed
        try:
            if not self.folder.is_dir():
                make_folder(self.folder)
            lock = place.with_suffix(".lock").open("wb")
            self._held[place] = lock
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                fcntl.flock(lock, fcntl.LOCK_EX)
                return True
            # It may have been saved since it was looked for.
            return place.is_file()
        except OSError:
            return False

    def end(self, key: Any) -> None:
        """Let go of the lock. Its file stays: another process may be waiting for it."""
        lock = self._held.pop(self.path(key), None)
        if lock is not None:
            lock.close()

    def is_locked(self, key: Any) -> bool:
        """Whether another process holds the lock of a kernel."""
        if fcntl is None:
            return False
        try:
            with self.path(key).with_suffix(".lock").open("rb") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        except OSError:
            return False
        return False

    def flush(self) -> None:
        for path in self.folder.glob(f"{self.name}.*.kernel"):
            path.unlink(missing_ok=True)


def cache_of(function: FunctionType) -> caching._Cache:
    """Where the compiled versions of a kernel are kept; a cache that keeps nothing where nothing can be kept."""
    source = function.__globals__.get("__file__")
    folder = _folder(function.__module__, Path(source)) if source else None
    if folder is None:
        return caching.NullCache()
    mark_used(folder)
    return KernelCache(function, folder)


def folder_of(module: str) -> Path | None:
    """Where the kernels of a module of the package are kept, without importing it; None if they cannot be kept."""
    source = _file_of(module)
    return None if source is None else _folder(module, source)


def _folder(module: str, source: Path) -> Path | None:
    parent = writable_parent()
    stamp = fingerprint(source.resolve()) if parent else None
    return parent / f"{module}-{stamp}" if parent and stamp else None


def is_being_compiled(kernel: Any, arguments: tuple[Any, ...]) -> bool:
    """Whether another process compiles a kernel for these types right now."""
    cache = kernel._cache
    return isinstance(cache, KernelCache) and cache.is_being_compiled(arguments, kernel.targetctx)


# ---- which sources


@functools.cache
def fingerprint(source: Path) -> str | None:
    """Hash of what decides the machine code of the kernels in a source file; None if it cannot be known, because a
    source is not there, or changed after this process had started and may have been loaded before."""
    total = hashlib.sha256(repr(environment()).encode())
    try:
        for file in sorted(sources_of(source)):
            if changed_since(file, compgs.started):
                return None
            total.update(f"{file.name} ".encode() + _read(file)[0].encode())
    except (OSError, ValueError):
        return None
    return total.hexdigest()[:24]


def sources_of(source: Path) -> set[Path]:
    """A source file, and all of the package that it imports, directly or not. Raises OSError, ValueError."""
    found: set[Path] = set()
    waiting = [source]
    while waiting:
        file = waiting.pop()
        if file not in found:
            found.add(file)
            waiting += _read(file)[1]
    return found


@functools.cache
def _read(source: Path) -> tuple[str, list[Path]]:
    """Digest of a source file, and the files of the package that it imports."""
    data = source.read_bytes()
    return _digest(data), sorted(imported_files(data.decode()))


def imported_files(text: str) -> set[Path]:
    """The files of the package that a module's imports mean, wherever in it they stand. (Parsing the sources
    properly takes ten times as long, in every process; a test compares the two.)"""
    found: set[Path] = set()
    for module, names in IMPORT.findall(FOR_THE_TYPE_CHECKER.sub("", text)):
        submodules = [_file_of(f"{module}.{name}") for name in re.findall(r"\w+", names)]
        found |= {file for file in (_file_of(module), *submodules) if file}
    return found


def _file_of(module: str) -> Path | None:
    """The file of a module of the package; None for what is no module."""
    place = PACKAGE.joinpath(*module.split(".")[1:])
    return next((file for file in (place.with_suffix(".py"), place / "__init__.py") if file.is_file()), None)


def changed_since(file: Path, moment: float) -> bool:
    """Whether a file was written, or put in its place, after a moment (seconds since the epoch)."""
    status = file.stat()
    return max(status.st_mtime, status.st_ctime) > moment - CLOCK_TICK


@functools.cache
def environment() -> tuple[str, ...]:
    """What besides the sources decides the machine code, the processor apart, which is part of numba's key."""
    settings = [f"{name}={getattr(numba.config, name, None)}" for name in SETTINGS]
    versions = [platform.python_version(), numba.__version__, llvmlite.__version__, numpy.__version__]
    return (sys.implementation.cache_tag, *versions, *settings)


# ---- which folder


@functools.cache
def writable_parent() -> Path | None:
    """The folder of all kernels: the first that can be written; None if there is none."""
    for place, private in ((chosen_folder(), False), (user_folder(), False), (temporary_folder(), True)):
        if place is not None and _usable(place / FOLDER if not private else place, private):
            return place if private else place / FOLDER
    return None


def chosen_folder() -> Path | None:
    """NUMBA_CACHE_DIR, if it is set."""
    folder = getattr(numba.config, "CACHE_DIR", "")
    return Path(folder) if folder else None


def user_folder() -> Path | None:
    """Where programs of this user keep what they can make again; None for a user without a home."""
    variable = {"win32": "LOCALAPPDATA", "darwin": ""}.get(sys.platform, "XDG_CACHE_HOME")
    if variable and os.path.isabs(os.environ.get(variable, "")):
        return Path(os.environ[variable])
    try:
        return Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache")
    except RuntimeError:
        return None


def temporary_folder() -> Path | None:
    """A folder of this user among the temporary files."""
    try:
        return Path(tempfile.gettempdir()) / f"{FOLDER}-{os.getuid() if hasattr(os, 'getuid') else 'user'}"
    except OSError:
        return None


def _usable(folder: Path, private: bool) -> bool:
    """Whether files can be made in a folder, after making it. A private one is nobody else's: who could put a file
    there could have it run."""
    try:
        folder.mkdir(mode=0o700 if private else 0o777, parents=not private, exist_ok=True)
        if private and not _ours_alone(folder):
            return False
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


def _ours_alone(folder: Path) -> bool:
    if not hasattr(os, "getuid"):
        return True
    status = folder.lstat()
    return stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o077


def mark_used(folder: Path) -> None:
    """So that a folder in use is not among the oldest."""
    try:
        if time.time() - folder.stat().st_mtime > TOUCH_SECONDS:
            os.utime(folder)
    except OSError:
        pass


def make_folder(folder: Path) -> None:
    """Make the folder of a module's kernels, and remove the oldest of its earlier versions. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    module = folder.name.rpartition("-")[0]
    for old in sorted(folder.parent.glob(f"{module}-*"), key=_age)[FOLDERS_KEPT:]:
        if old != folder:
            shutil.rmtree(old, ignore_errors=True)


def _age(folder: Path) -> float:
    try:
        return -folder.stat().st_mtime
    except OSError:
        return 0.0


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
