"""Compiles kernels side by side on a machine that has none yet.

numba compiles one kernel at a time in a process. A command that finds kernels missing starts helpers: processes that
compile, from the list in `kernels.json`, what the command will need, while it does the rest. Command and helpers share
the cache; who begins a kernel holds its lock, whoever else needs it waits for the file (`kernel_cache`). Helpers are
best effort: nothing depends on them, they print nothing, and they end with the command that started them.

The list names, for each stage of work, the kernels in the order in which they are needed, with the types of their
arguments. It only decides what is compiled early: a kernel that it lacks is compiled when it is called.
`benchmarks/cold_start.py --list` writes it.
"""

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

from numba import types

from compgs.numerics.compiled import Kernel
from compgs.numerics.kernel_cache import PACKAGE, folder_of, is_being_compiled

LIST = Path(__file__).with_name("kernels.json")
NOTHING = subprocess.DEVNULL
MOST_HELPERS = 3  # more would mostly wait for kernels that others contain


class Entry(NamedTuple):
    """A kernel that will be needed."""

    module: str
    name: str
    arguments: str  # types, as `spelled`

    def kernel(self) -> Any:
        return getattr(importlib.import_module(self.module), self.name)

    def types(self) -> tuple[Any, ...]:
        return tuple(eval(self.arguments, {**vars(types), "named": _named}))


def listed(stages: tuple[str, ...]) -> list[Entry]:
    """Kernels of some stages of work."""
    stored = json.loads(LIST.read_text(encoding="utf-8"))
    return list(dict.fromkeys(Entry(*entry) for stage in stages for entry in stored[stage]))


# ---- the command's side

_helpers: list[subprocess.Popen[bytes]] = []  # of this process


def start_helpers(*stages: str) -> None:
    """Let helpers compile what these stages need, if a module of theirs has no kernels yet and there are cores."""
    helpers = min(MOST_HELPERS, cores() - 1)
    if helpers < 1 or not sys.executable or getattr(sys, "frozen", False) or not _missing(listed(stages)):
        return
    variables = os.environ | {"PYTHONPATH": os.pathsep.join([str(PACKAGE.parent), *_search_path()])}
    for i in range(helpers):
        command = [sys.executable, "-P", "-m", "compgs.numerics.ahead", f"{i}/{helpers}", *stages]
        try:
            helper = subprocess.Popen(command, env=variables, stdin=NOTHING, stdout=NOTHING, stderr=NOTHING)
        except OSError:
            return
        _helpers.append(helper)


def cores() -> int:
    """That this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _missing(entries: list[Entry]) -> bool:
    folders = {module: folder_of(module) for module in {entry.module for entry in entries}}
    return any(folder is not None and not folder.is_dir() for folder in folders.values())


def _search_path() -> list[str]:
    given = os.environ.get("PYTHONPATH", "")
    return [given] if given else []


# ---- the helper's side


def help_compile(entries: list[Entry]) -> None:
    """Compile what nobody has compiled, and nobody is compiling; ends when the command does."""
    parent = os.getppid()
    for entry in entries:
        if os.getppid() != parent:
            return
        kernel, arguments = entry.kernel(), entry.types()
        if not is_being_compiled(kernel, arguments):
            kernel.compile(arguments)


def order(entries: list[Entry], turn: int, helpers: int) -> list[Entry]:
    """Where a helper begins. The command compiles from the front: the first begins at the end, others between."""
    backwards = entries[::-1]
    begin = len(entries) * turn // helpers
    return backwards[begin:] + backwards[:begin]


def main(words: list[str]) -> None:
    turn, helpers = map(int, words[0].split("/"))
    help_compile(order(listed(tuple(words[1:])), turn, helpers))


# ---- writing the list


def write_list(entries: dict[str, list[Entry]]) -> None:
    """Write the list: entries by stage, one a line."""
    stages = [
        f" {json.dumps(stage)}: [\n" + ",\n".join(f"  {json.dumps(entry)}" for entry in found) + "\n ]"
        for stage, found in entries.items()
    ]
    LIST.write_text("{\n" + ",\n".join(stages) + "\n}\n", encoding="utf-8")


def entry_of(kernel: Any, arguments: tuple[Any, ...]) -> Entry:
    """How the list names a kernel."""
    return Entry(kernel.__module__, kernel.__name__, spelled(arguments))


def used_kernels() -> list[Entry]:
    """All kernels that this process has compiled or loaded."""
    modules = [module for name, module in sorted(sys.modules.items()) if name.startswith("compgs.")]
    found = {id(k): k for module in modules for k in vars(module).values() if isinstance(k, Kernel)}
    return [entry_of(kernel, arguments) for kernel in found.values() for arguments in kernel.overloads]


def spelled(arguments: tuple[Any, ...]) -> str:
    """Types as an expression."""
    return f"({''.join(f'{_spelled(kind)}, ' for kind in arguments).strip()})"


def _spelled(kind: Any) -> str:
    elements: Any = kind
    if isinstance(kind, types.BaseNamedTuple):
        cls = elements.instance_class
        return f'named("{cls.__module__}", "{cls.__name__}"){spelled(tuple(elements))}'
    if isinstance(kind, types.Array):
        return f"Array({_spelled(kind.dtype)}, {kind.ndim}, {kind.layout!r}, readonly={not kind.mutable})"
    if isinstance(kind, types.BaseTuple):
        return f"BaseTuple.from_types({spelled(tuple(elements))})"
    if isinstance(kind, types.Omitted):
        return f"Omitted({kind.value!r})"
    return "boolean" if kind == types.boolean else str(kind)


def _named(module: str, name: str) -> Any:
    """Maker of the type of a named tuple."""
    cls = getattr(importlib.import_module(module), name)
    return lambda *kinds: types.BaseTuple.from_types(kinds, cls)


if __name__ == "__main__":
    main(sys.argv[1:])
