"""The house's rules: who may import whom, and what decoding must not load."""

import ast
import functools
import os
import subprocess
import sys
from pathlib import Path

import compgs

SOURCE = Path(compgs.__file__).parent

# A part may import itself, and the parts named here.
BASE = {
    "compgs", "numerics", "errors", "extras", "gaussians", "cameras", "config", "former_settings", "interrupt",
    "notes", "occupied", "outputs", "paths", "pictures", "presets", "progress", "words",
}  # fmt: skip
ALLOWED = {
    "compgs": {
        "errors",
        "extras",
        "gaussians",
        "cameras",
        "config",
        "scene",
        "training",
        "codec",
        "render",
        "evaluation",
        "formats",
        "opening",
        "exporting",
        "compressing",
        "methods",
    },
    "errors": set(),
    "extras": {"errors"},
    "devices": {"errors", "extras", "tensors"},
    "interrupt": set(),
    "notes": set(),
    "outputs": {"errors"},
    "occupied": {"errors", "outputs"},
    "paths": {"errors"},
    "pictures": set(),
    "progress": {"words"},
    "words": set(),
    "gaussians": set(),
    "cameras": set(),
    "config": {"errors", "former_settings", "presets"},
    "former_settings": {"errors"},
    "presets": set(),
    "numerics": {"compgs", "extras"},  # `compgs.started`
    "scene": BASE,
    "render": BASE,
    "ordering": BASE,
    "model": BASE,
    "tensors": BASE | {"model", "render"},
    "entropy": BASE | {"tensors", "ordering"},
    "losses": BASE | {"tensors"},
    "stereo": BASE | {"scene"},
    "lpips": BASE,
    "metrics": BASE | {"lpips"},
    "stored_weights": BASE | {"model", "entropy"},
    "trained_model": BASE | {"model", "entropy", "tensors", "devices", "stored_weights"},
    "codec": BASE | {"model", "devices", "entropy", "trained_model", "ordering"},
    "formats": BASE | {"model", "render", "devices", "codec"},
    "published": BASE | {"model", "render", "devices", "codec", "formats"},
    "opening": BASE | {"model", "render", "devices", "formats", "published"},
    "training": BASE
    | {"scene", "render", "model", "tensors", "devices", "entropy", "losses", "metrics", "trained_model"}
    | {
        "stereo",
        "stored_weights",
        "codec",
        "ordering",
    },  # what positions and masks take, for a size that is asked for
    "methods": BASE
    | {"scene", "model", "entropy", "render", "tensors", "devices", "losses", "metrics", "codec", "formats"}
    | {"published", "opening", "training", "trained_model", "stored_weights", "ordering"},
    "reconstruct": BASE | {"scene"},
    "evaluation": BASE | {"scene", "render", "model", "devices", "metrics", "codec", "formats", "opening"},
    "viewer": BASE | {"render", "model", "devices", "metrics", "codec", "formats", "opening", "evaluation"},
    "exporting": BASE
    | {"render", "model", "devices", "metrics", "formats", "opening", "evaluation", "viewer"},
    "compressing": BASE
    | {
        "scene",
        "render",
        "model",
        "devices",
        "metrics",
        "formats",
        "opening",
        "codec",
        "evaluation",
        "training",
        "methods",
    },
    "suites": BASE | {"evaluation", "methods", "metrics"},
    "tiles": BASE | {"scene", "formats", "suites"},
    "cli": BASE
    | {"scene", "render", "model", "devices", "metrics", "codec", "formats", "opening"}
    | {
        "training",
        "evaluation",
        "trained_model",
        "exporting",
        "compressing",
        "viewer",
        "methods",
        "reconstruct",
        "suites",
        "tiles",
    },
    "__main__": BASE | {"cli"},
}


@functools.cache
def parsed(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


def part_of(module: str) -> str:
    """`compgs.scene.colmap` belongs to `scene`; `compgs` is the package's own __init__."""
    names = module.split(".")
    return names[1] if len(names) > 1 else "compgs"


def imported_parts(file: Path) -> set[str]:
    """Parts of the package that a source file imports, anywhere in it."""
    found: set[str] = set()
    for node in ast.walk(parsed(file)):
        if isinstance(node, ast.Import):
            found |= {part_of(alias.name) for alias in node.names if alias.name.split(".")[0] == "compgs"}
        elif isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "compgs":
            if node.module == "compgs":
                submodules = {p.stem for p in SOURCE.iterdir()}
                found |= {alias.name if alias.name in submodules else "compgs" for alias in node.names}
            else:
                found.add(part_of(node.module))
    return found


def test_imports_point_one_way() -> None:
    for file in SOURCE.rglob("*.py"):
        relative = file.relative_to(SOURCE).with_suffix("").parts
        part = "compgs" if relative == ("__init__",) else relative[0]
        assert part in ALLOWED, f"{part} is new: say in this test what it may import"
        assert imported_parts(file) <= ALLOWED[part] | {part}, file


def module_imports() -> dict[str, set[str]]:
    """The modules of the package, and which others each of them imports: anywhere in it, also for types alone. The
    package's own face is left out, which finds its names when they are asked for.
    """
    files = {}
    for file in SOURCE.rglob("*.py"):
        names = file.relative_to(SOURCE.parent).with_suffix("").parts
        files[".".join(names[:-1] if names[-1] == "__init__" else names)] = file
    found: dict[str, set[str]] = {}
    for module, file in files.items():
        found[module] = set()
        for node in ast.walk(parsed(file)):
            named = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module:
                inner = [f"{node.module}.{alias.name}" for alias in node.names]
                named = [name if name in files else node.module for name in inner]
            found[module] |= {name for name in named if name in files} - {module, "compgs"}
    return found


def in_circles(imports: dict[str, set[str]]) -> set[str]:
    """The modules that come back to themselves, found by taking away all those that need nobody, or that nobody needs,
    until none is left to take.
    """
    left = {module: set(others) for module, others in imports.items()}
    while True:
        needed = set().union(*left.values()) if left else set()
        ends = {module for module, others in left.items() if not others or module not in needed}
        if not ends:
            return set(left)
        left = {module: others - ends for module, others in left.items() if module not in ends}


def test_a_circle_of_imports_would_be_found() -> None:
    chain = {"a": {"b"}, "b": {"c"}, "c": set(), "d": {"b"}}
    assert in_circles(chain) == set()
    assert in_circles({**chain, "c": {"a"}}) == {"a", "b", "c"}


def test_no_module_needs_itself_by_way_of_others() -> None:
    assert in_circles(module_imports()) == set()


# What trains, and what it alone needs. Everything else computes with numpy and numba.
HEAVY = {"torch", "scipy", "safetensors"}
TRAINS = {
    "tensors", "entropy", "losses", "stored_weights", "stereo", "trained_model", "training", "codec.encoder",
    *(f"methods.parts.{name}" for name in ("vector_quantization", "fake_quantization", "significance")),
    "methods.compact_3dgs.tensors", "methods.c3dgs.sensitivity", "methods.c3dgs.shapes",
    *(f"methods.anchors.{part}" for part in ("networks", "prediction", "model", "trainer")),
    *(f"methods.cosa.{part}" for part in ("entropy", "model", "trainer", "writer", "rounding")),
}  # fmt: skip
HOOKS = "hooks"  # what a method's hooks are called, in `methods`: they train, too
# Where one of HEAVY is loaded beside that, inside a function, for what cannot be done without it.
LOADS = {
    "cli.command": "threads of a training",
    "devices": "CUDA",
    "evaluation.bd_rate": "interpolation",
    "lpips.network": "LPIPS",
    "numerics.nearest": "a k-d tree",
}


def loads_heavy(file: Path, *, at_import: bool) -> bool:
    """Whether a source file imports one of HEAVY: anywhere in it, or as soon as it is itself imported."""
    tree = parsed(file)
    typing_only = {
        id(node)
        for guard in ast.walk(tree)
        if isinstance(guard, ast.If) and isinstance(guard.test, ast.Name) and guard.test.id == "TYPE_CHECKING"
        for node in ast.walk(guard)
    }
    for node in tree.body if at_import else ast.walk(tree):
        modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        modules += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        if id(node) not in typing_only and {module.split(".")[0] for module in modules} & HEAVY:
            return True
    return False


def test_torch_scipy_and_safetensors_are_imported_where_training_is_and_nowhere_else() -> None:
    for file in SOURCE.rglob("*.py"):
        names = file.relative_to(SOURCE).with_suffix("").parts
        name = ".".join(names)
        if names[0] in TRAINS or name in TRAINS or (names[0] == "methods" and names[-1] == HOOKS):
            continue
        assert not loads_heavy(file, at_import=True), name
        assert loads_heavy(file, at_import=False) == (name in LOADS), name


def test_what_only_looks_at_scenes_never_reaches_the_rooms_that_train() -> None:
    """But through `devices` (CUDA), `codec` (the encoder stands beside the decoder), `methods` (train and open)
    and `compressing` (trains on splats)."""
    rooms = {name for name in TRAINS if "." not in name}
    assert {name for name in ALLOWED if ALLOWED[name] & rooms and name not in rooms} == {
        "compgs", "devices", "codec", "methods", "compressing", "cli",
    }  # fmt: skip


def test_only_the_command_line_prints() -> None:
    printing = [
        str(file.relative_to(SOURCE))
        for file in SOURCE.rglob("*.py")
        if file.relative_to(SOURCE).parts[0] != "cli"
        for node in ast.walk(parsed(file))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
    ]
    assert printing == []


def loaded_after_each(*statements: str) -> list[set[str]]:
    """Names of the modules that one fresh interpreter has loaded after each of some statements, run in this order."""
    program = "import sys\n" + "".join(f"{statement}\nprint(*sys.modules)\n" for statement in statements)
    environment = {k: v for k, v in os.environ.items() if not k.startswith("COV")}
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, env=environment, check=True
    )
    return [set(line.split()) for line in done.stdout.splitlines()]


def test_names_formats_and_the_command_line_start_without_torch_and_numba() -> None:
    package, command_line, formats, methods = loaded_after_each(
        "import compgs",
        "import compgs.cli.main",
        "import compgs.formats",
        "import compgs.methods; compgs.methods.settings_of('3dgs')",
    )
    for loaded, expected in (
        (package, "compgs"),
        (command_line, "tyro"),
        (formats, "compgs.formats.sog"),
        (methods, "compgs.methods.splats"),
    ):
        assert expected in loaded
        assert not loaded & {"torch", "numba", "scipy", "compgs.training"}
    assert "PIL" not in command_line


def test_what_opens_files_of_other_methods_loads_no_torch() -> None:
    folder = SOURCE / "published"
    files = [file for file in folder.rglob("*.py") if file.name != "__init__.py"]
    names = [".".join(file.relative_to(folder).with_suffix("").parts) for file in files]
    (loaded,) = loaded_after_each("; ".join(f"import compgs.published.{name}" for name in names))
    assert {"compgs.published.c3dgs", "compgs.published.cosa.reader"} <= loaded
    assert not loaded & {"torch", "compgs.training", "compgs.methods"}


CODING = (
    "rans", "tables", "integer_network", "octree", "mask_coder", "weights", "reader", "viewpoints",
    "viewpoint_cameras",
)  # fmt: skip


def test_from_bytes_to_a_scene_neither_torch_nor_scenes_losses_or_training_are_loaded() -> None:
    modules = [f"compgs.codec.{module}" for module in (*CODING, "decoder")]
    forbidden = {"scene", "losses", "metrics", "training", "evaluation", "cli", "trained_model"}
    for module, loaded in zip(
        modules, loaded_after_each(*(f"import {module}" for module in modules)), strict=True
    ):
        assert module in loaded
        assert not loaded & {"torch", "compgs.numerics.ssim"}, module
        assert not {m for m in loaded if m.startswith("compgs.") and part_of(m) in forbidden}, module


def test_looking_at_scenes_loads_no_torch() -> None:
    packages = ("model", "render", "formats", "evaluation", "exporting", "viewer", "metrics")
    modules = [
        [
            f"compgs.{package}",
            *(f"compgs.{package}.{file.stem}" for file in (SOURCE / package).glob("[a-z]*.py")),
        ]
        for package in packages
    ]
    for names, loaded in zip(
        modules, loaded_after_each(*("import " + ", ".join(names) for names in modules)), strict=True
    ):
        assert set(names) <= loaded
        # numba asks for scipy's version wherever it is installed
        assert not loaded & (HEAVY - {"scipy"}), names[0]


def test_public_names_exist() -> None:
    for name in compgs.__all__:
        assert getattr(compgs, name) is not None


def test_public_functions_stay_functions_whatever_was_imported() -> None:
    parts = sorted(p.name for p in SOURCE.iterdir() if (p / "__init__.py").is_file())
    names = [name for name in compgs.__all__ if name[0].islower()]
    everything = ", ".join(f"compgs.{part}" for part in parts)
    loaded_after_each(f"import {everything}; assert all(callable(getattr(compgs, name)) for name in {names})")
