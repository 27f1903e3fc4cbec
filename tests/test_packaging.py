"""Image, action and conda recipe say what the package says, and name only files that are there."""

import fnmatch
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

import compgs

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
yaml = pytest.importorskip("yaml", reason="comes with the extra `docs`")
DOCKERFILES = (ROOT / "docker" / "Dockerfile", ROOT / "docker" / "cuda.Dockerfile")


def parsed(path: str) -> Any:
    return yaml.safe_load((ROOT / path).read_text(encoding="utf-8"))


def test_the_conda_recipe_needs_what_the_package_needs() -> None:
    recipe = parsed("conda/recipe.yaml")
    run = [re.sub(r"\s", "", line) for line in recipe["requirements"]["run"]]
    assert run == [f"python{PROJECT['requires-python']}", *PROJECT["dependencies"]]
    assert str(recipe["context"]["version"]) == compgs.__version__
    assert recipe["about"]["license"] == PROJECT["license"]
    assert recipe["about"]["summary"] == PROJECT["description"]
    (entry,) = recipe["build"]["python"]["entry_points"]
    assert entry == f"compgs = {PROJECT['scripts']['compgs']}"
    for name in recipe["tests"][1]["files"]["source"]:
        assert (ROOT / name).is_file()


def test_the_conda_recipe_can_be_rendered() -> None:
    build = pytest.importorskip("rattler_build", reason="pip install py-rattler-build")
    recipe = build.Stage0Recipe.from_file(str(ROOT / "conda" / "recipe.yaml"))
    (variant,) = recipe.render(build.VariantConfig(), build.RenderConfig())
    rendered = variant.recipe() if callable(variant.recipe) else variant.recipe
    assert (rendered.package.name, str(rendered.package.version)) == ("compgs", compgs.__version__)


@pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.name)
def test_what_an_image_copies_is_there_and_is_not_ignored(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    kept = [line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")]
    sources = [
        source
        for line in re.findall(r"^COPY (.*)$", text, re.M)
        if "--from=" not in line
        for source in [part for part in line.split() if not part.startswith("--")][:-1]
    ]
    assert len(sources) >= 6
    for source in sources:
        assert (ROOT / source).exists(), source
        assert any(source == each or fnmatch.fnmatch(source, f"{each}/*") for each in kept), source
    for base in re.findall(r"^FROM (\S+)", text, re.M):
        assert ":" in base, f"{base}: a base without a tag changes under the image"
        assert "." not in base.partition("/")[0].partition(":")[0], f"{base}: short names only"


@pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.name)
def test_an_image_has_extras_that_there_are(path: Path) -> None:
    (extras,) = re.findall(r"^ARG EXTRAS=(\S+)$", path.read_text(encoding="utf-8"), re.M)
    assert set(extras.split(",")) <= set(PROJECT["optional-dependencies"])


def test_every_input_of_the_action_is_used_and_every_one_used_is_there() -> None:
    action = parsed("action/action.yml")
    text = (ROOT / "action" / "action.yml").read_text(encoding="utf-8")
    assert set(re.findall(r"inputs\.(\w+)", text)) == set(action["inputs"])
    assert action["runs"]["using"] == "composite"
    steps = action["runs"]["steps"]
    assert all("shell" in step for step in steps if "run" in step)
    named = {step["id"] for step in steps if "id" in step}
    assert set(re.findall(r"steps\.(\w+)\.outputs", text)) <= named
    # What a pull request may set is never part of a script's text.
    for step in steps:
        assert "${{" not in step.get("run", ""), step["name"]
    convert = next(step for step in steps if step.get("id") == "convert")
    script = (ROOT / "action" / "convert.sh").read_text(encoding="utf-8")
    given = {"RUNNER_TEMP", "GITHUB_OUTPUT", "GITHUB_STEP_SUMMARY"}
    assert set(re.findall(r"\$([A-Z_]+)", script)) == {*convert["env"], *given}
