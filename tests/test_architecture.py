"""The house's rules: who may import whom, and what decoding must not load."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

import compgs

SOURCE = Path(compgs.__file__).parent

# A part may import itself, and the parts named here.
BASE = {
    "compgs", "numerics", "errors", "gaussians", "cameras", "config", "interrupt", "outputs", "presets",
}  # fmt: skip
ALLOWED = {
    "compgs": {
        "errors",
        "gaussians",
        "cameras",
        "config",
        "scene",
        "training",
        "codec",
        "render",
        "evaluation",
        "formats",
        "exporting",
        "compressing",
    },
    "errors": set(),
    "interrupt": set(),
    "outputs": {"errors"},
    "gaussians": set(),
    "cameras": set(),
    "config": {"errors", "presets"},
    "presets": set(),
    "numerics": {"compgs"},  # for `compgs.started`
    "scene": BASE,
    "render": BASE,
    "model": BASE,
    "entropy": BASE,
    "losses": BASE,
    "metrics": BASE,
    "stored_weights": BASE | {"model", "entropy"},
    "trained_model": BASE | {"model", "entropy", "stored_weights"},
    "codec": BASE | {"model", "entropy", "trained_model"},
    "formats": BASE | {"model", "render", "codec"},
    "training": BASE | {"scene", "render", "model", "entropy", "losses", "metrics", "trained_model"},
    "reconstruct": BASE | {"scene"},
    "evaluation": BASE | {"scene", "render", "model", "entropy", "metrics", "codec", "formats"},
    "compressing": BASE
    | {"scene", "render", "model", "metrics", "formats", "codec", "evaluation", "training"},
    "viewer": BASE,
    "exporting": BASE | {"render", "model", "metrics", "formats", "evaluation", "viewer"},
    "cli": BASE
    | {"scene", "render", "model", "metrics", "codec", "formats", "training", "evaluation"}
    | {"trained_model", "exporting", "compressing", "viewer", "reconstruct"},
    "__main__": BASE | {"cli"},
}


def part_of(module: str) -> str:
    """`compgs.scene.colmap` belongs to `scene`; `compgs` is the package's own __init__."""
    names = module.split(".")
    return names[1] if len(names) > 1 else "compgs"


def imported_parts(file: Path) -> set[str]:
    """Parts of the package that a source file imports, anywhere in it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {part_of(alias.name) for alias in node.names if alias.name.split(".")[0] == "compgs"}
        elif isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "compgs":
            if node.module == "compgs":
                submodules = {p.stem for p in SOURCE.iterdir()}
                found |= {alias.name if alias.name in submodules else "compgs" for alias in node.names}
            else:
                found.add(part_of(node.module))
    return found


@pytest.mark.parametrize("file", sorted(SOURCE.rglob("*.py")), ids=lambda f: str(f.relative_to(SOURCE)))
def test_imports_point_one_way(file: Path) -> None:
    relative = file.relative_to(SOURCE).with_suffix("").parts
    part = "compgs" if relative == ("__init__",) else relative[0]
    assert part in ALLOWED, f"{part} is new: say in this test what it may import"
    assert imported_parts(file) <= ALLOWED[part] | {part}


def test_only_the_command_line_prints() -> None:
    printing = [
        str(file.relative_to(SOURCE))
        for file in SOURCE.rglob("*.py")
        if file.relative_to(SOURCE).parts[0] != "cli"
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
    ]
    assert printing == []


def modules_after(statement: str) -> set[str]:
    """Names of the modules loaded in a fresh interpreter after a statement."""
    program = f"import sys; {statement}; print('\\n'.join(sys.modules))"
    environment = {k: v for k, v in os.environ.items() if not k.startswith("COV")}
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, env=environment, check=True
    )
    return set(done.stdout.split())


def test_importing_the_package_loads_neither_torch_nor_numba() -> None:
    loaded = modules_after("import compgs")
    assert "compgs" in loaded
    assert not loaded & {"torch", "numba", "scipy", "PIL"}


def test_formats_are_read_and_written_without_torch() -> None:
    loaded = modules_after("import compgs.formats")
    assert "compgs.formats.sog" in loaded
    assert not loaded & {"torch", "numba", "scipy"}


def test_the_command_line_starts_without_torch() -> None:
    loaded = modules_after("import compgs.cli.main")
    assert "tyro" in loaded
    assert not loaded & {"torch", "numba", "scipy", "PIL"}


def test_decoding_never_loads_scenes_losses_or_training() -> None:
    loaded = modules_after("import compgs.codec.decoder")
    assert "compgs.codec.decoder" in loaded
    forbidden = {"scene", "losses", "metrics", "training", "evaluation", "cli", "trained_model"}
    assert not {m for m in loaded if m.startswith("compgs.") and part_of(m) in forbidden}
    assert "compgs.numerics.ssim" not in loaded


@pytest.mark.parametrize(
    "module",
    [
        "rans",
        "tables",
        "integer_network",
        "octree",
        "mask_coder",
        "weights",
        "reader",
        "viewpoints",
        "viewpoint_cameras",
    ],
)
def test_from_bytes_to_symbols_no_torch_is_loaded(module: str) -> None:
    loaded = modules_after(f"import compgs.codec.{module}")
    assert f"compgs.codec.{module}" in loaded
    assert "torch" not in loaded


@pytest.mark.parametrize(
    "module",
    [
        "constants",
        "arrays",
        "residual_mlp_kernels",
        "prediction_kernels",
        "spherical_harmonics_kernels",
        "inference",
    ],
)
def test_from_arrays_to_gaussians_no_torch_is_loaded(module: str) -> None:
    loaded = modules_after(f"import compgs.model.{module}")
    assert f"compgs.model.{module}" in loaded
    assert "torch" not in loaded


def test_public_names_exist() -> None:
    for name in compgs.__all__:
        assert getattr(compgs, name) is not None


def test_public_functions_stay_functions_whatever_was_imported() -> None:
    parts = sorted(p.name for p in SOURCE.iterdir() if (p / "__init__.py").is_file())
    names = [name for name in compgs.__all__ if name[0].islower()]
    loaded = "; ".join(f"import compgs.{part}" for part in parts)
    modules_after(f"{loaded}; assert all(callable(getattr(compgs, name)) for name in {names})")
