"""What is not installed with the package alone, and what needs it: said before any work is done."""

import importlib.util

from compgs.errors import MissingDependency, install_line

# Packages by the extra that installs them.
PACKAGES: dict[str, tuple[str, ...]] = {
    "train": ("torch", "scipy", "safetensors"),
    "cuda": ("torch", "gsplat"),
    "reconstruct": ("pycolmap",),
    "view": ("viser",),
    "cluster": ("ray",),
}


def missing(extra: str) -> list[str]:
    """Packages of the extra that are not installed here; none is loaded."""
    return [package for package in PACKAGES[extra] if importlib.util.find_spec(package) is None]


def require(extra: str, what: str) -> None:
    """Raises MissingDependency, which says that `what` needs what is missing, and how to install it."""
    packages = missing(extra)
    if packages:
        listed = " and ".join([", ".join(packages[:-1])] * (len(packages) > 1) + packages[-1:])
        raise MissingDependency(f"{what} needs {listed}: {install_line(extra)}")
