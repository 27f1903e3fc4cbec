"""Every `compgs` command that the documentation shows is run as it is written, on a scene of a few pixels.

Only four things differ: runs and the fitting of baked splats are shortened to a few steps, tours to two frames, and
servers end when they have begun.
"""

import re
import shlex
import shutil
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from compgs.cli.main import main
from compgs.cli.run_folder import RunSettings
from compgs.cli.train import Train
from compgs.cli.training_command import TrainingCommand
from compgs.formats.refining import refine
from compgs.scene.generated import generate_scene

ROOT = Path(__file__).resolve().parents[2]
PAGES = ("README.md", *sorted(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md")))
STEPS = 6
# What needs data sets or several machines; and what tests/reconstruct and tests/compressing run.
ELSEWHERE = (
    "--cluster",
    "mip_nerf_360",
    "benchmark captures",
    "compgs reconstruct",
    "compgs adjust",
    "compgs compress",
)


def commands() -> list[tuple[str, str]]:
    """(page, command) of all lines of shell blocks that begin with compgs; each command once."""
    found: dict[str, str] = {}
    for page in PAGES:
        text = (ROOT / page).read_text(encoding="utf-8")
        for language, block in re.findall(r"^```(\w*)\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE):
            for line in block.splitlines() if language in ("", "sh") else ():
                command = line.partition(" #")[0].strip()
                if command.startswith("compgs ") and not any(word in command for word in ELSEWHERE):
                    found.setdefault(command, page)
    return [(page, command) for command, page in found.items()]


def cases() -> list[Any]:
    """`commands`; those of other pages than the README are for the complete run."""
    return [
        pytest.param(
            page, command, id=f"{page}-{command}"[:80], marks=() if page == "README.md" else pytest.mark.slow
        )
        for page, command in commands()
    ]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What somebody who follows the documentation has after a while."""
    folder = tmp_path_factory.mktemp("world")
    generate_scene(folder / "scenes" / "garden", views=9, width=48, height=36)
    for copy in ("city", "garden_adjusted"):
        shutil.copytree(folder / "scenes" / "garden", folder / "scenes" / copy)
    patch = pytest.MonkeyPatch()
    patch.chdir(folder)
    shorten(patch)
    try:
        for arguments in (
            ["train", "scenes/garden", "-o", "runs/garden"],
            ["train", "scenes/garden", "-o", "runs/plain", "--method", "3dgs"],
            ["train", "scenes/garden", "-o", "runs/paper", "--preset", "paper"],
            ["tiles", "scenes/city", "-o", "runs/city", "--grid", "2x1"],
        ):
            assert main(arguments) == 0
    finally:
        patch.undo()
    shutil.copy(folder / "runs" / "garden" / "garden.cgs", folder / "garden.cgs")
    shutil.copy(ROOT / "tests" / "golden" / "default.cgs", folder / "city.cgs")
    shutil.copy(folder / "runs" / "plain" / "plain.ply", folder / "scene.ply")
    shutil.copy(folder / "runs" / "plain" / "plain.ply", folder / "garden.ply")
    shutil.copy(folder / "runs" / "plain" / "plain.ply", folder / "before.ply")
    for source, target in (
        ("scene.ply", "garden.spz"),
        ("scene.ply", "scene.sog"),
        ("scene.ply", "after.sog"),
    ):
        assert main(["export", str(folder / source), str(folder / target)]) == 0
    shutil.copytree(folder / "runs" / "garden", folder / "runs" / "ours")
    return folder


def shorten(patch: pytest.MonkeyPatch) -> None:
    whole, timed = TrainingCommand.settings, Train.timed

    def settings(self: TrainingCommand, folder: Path) -> Any:
        asked = whole(self, folder)
        return asked if self.resume else of_few_steps(asked)

    patch.setattr(TrainingCommand, "settings", settings)
    patch.setattr(Train, "timed", lambda self, asked, scene: of_few_steps(timed(self, asked, scene)))
    patch.setattr("compgs.suites.jobs._run", in_this_process)
    patch.setattr("compgs.exporting.refine_splats", refined_shortly)


def of_few_steps(asked: RunSettings) -> RunSettings:
    training = asked.config.training
    config = replace(asked.config, training=replace(training, steps=min(STEPS, training.steps)))
    return replace(asked, config=config)


def refined_shortly(baked: Any, model: Any, cameras: Any, steps: int, *others: Any, **named: Any) -> Any:
    return refine(baked, model, cameras, min(STEPS, steps), *others, **named)


def in_this_process(arguments: list[str], log: Path) -> int:
    """The run of a tile: starting an interpreter would take longer than its few steps."""
    log.write_text("")
    return main(list(arguments))


@pytest.fixture
def here(world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A copy of the world to work in."""
    folder = tmp_path / "world"
    shutil.copytree(world, folder)
    monkeypatch.chdir(folder)
    shorten(monkeypatch)
    monkeypatch.setattr("socketserver.BaseServer.serve_forever", lambda self, *args: None)
    monkeypatch.setattr(threading.Event, "wait", _ends(threading.Event.wait))
    yield folder


def _ends(wait: Any) -> Any:
    """Waiting for ever ends at once, as by Ctrl-C; other waiting is as it was."""

    def ended(self: threading.Event, timeout: float | None = None) -> bool:
        if timeout is None and threading.current_thread() is threading.main_thread() and _in_view():
            raise KeyboardInterrupt
        return bool(wait(self, timeout))

    return ended


def _in_view() -> bool:
    import inspect

    return any(frame.filename.endswith("cli/view.py") for frame in inspect.stack(0)[2:4])


@pytest.mark.parametrize(("page", "command"), cases())
def test_a_command_of_the_documentation_works(
    page: str, command: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = shlex.split(command)[1:]
    words = [
        part for word in words for part in (sorted(map(str, Path().glob(word))) if "*" in word else [word])
    ]
    if words[0] in ("view",) or "--viewer" in words:
        pytest.importorskip("viser", reason="the extra `view` is not installed")
    if any(word.endswith(".mp4") for word in words):
        pytest.importorskip("imageio_ffmpeg", reason="the extra `video` is not installed")
    if "--frames" in words:
        words[words.index("--frames") + 1] = "2"
    for flag in ("-o", "--output"):
        if flag in words and "--resume" not in words:
            _clear(here / words[words.index(flag) + 1])
    if words[0] == "export":
        _clear(here / words[2])
    code = main(words)
    said = capsys.readouterr()
    assert code == 0, f"{page}: {command}\n{said.err}{said.out[-500:]}"


def _clear(path: Path) -> None:
    """The command is shown as it is typed the first time."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def test_commands_are_found_on_many_pages() -> None:
    found = commands()
    assert len(found) > 30 and len({page for page, _ in found}) >= 6
    assert {"train", "render", "export", "compare", "report", "view", "serve", "encode", "decode"} <= {
        command.split()[1] for _, command in found
    }
