"""The installation without extras at the lowest versions that pyproject.toml allows: does it do what it says?

    python3 tools/check_bounds.py [--newest]

Installs the project into a new environment with `NAME==LOWEST` for every dependency (or, with --newest, what pip takes
today), runs tools/check_light.py there, and prints versions and size of what was installed. Needs the network, and a
Python that the lowest versions have wheels for: 3.11.
"""

import subprocess
import sys
import tempfile
import tomllib
import venv
from pathlib import Path

ROOT = Path(__file__).parents[1]
FILE = ROOT / "tests" / "golden" / "trained.cgs"


def lowest() -> list[str]:
    """Requirements that name the lowest version of every dependency."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return [line.replace(">=", "==") for line in project["dependencies"]]


def main() -> None:
    wanted = [] if "--newest" in sys.argv[1:] else lowest()
    with tempfile.TemporaryDirectory() as folder:
        environment = Path(folder, "environment")
        venv.create(environment, with_pip=True)
        python = next(environment.glob("[bS]*/python*"))
        pip = [str(python), "-m", "pip", "--disable-pip-version-check"]
        before = size_of(environment)
        subprocess.run([*pip, "install", "--quiet", str(ROOT), *wanted], check=True)
        print(f"{(size_of(environment) - before) / 1e6:.0f} MB were installed:")
        subprocess.run([*pip, "list"], check=True)
        subprocess.run(
            [str(python), str(ROOT / "tools" / "check_light.py"), str(FILE), f"{folder}/out"], check=True
        )


def size_of(folder: Path) -> int:
    """Bytes of all files."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


if __name__ == "__main__":
    main()
