"""`compgs tiles` on a generated scene of a few pixels: from photographs to a folder of tiles."""

import json
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

import compgs
from compgs import extras
from compgs.cli import training_command as train_command
from compgs.cli.main import main, parse
from compgs.cli.tiles import Tiles
from compgs.cli.train import Train
from compgs.formats.tiled import read_manifest
from compgs.formats.tiled_scene import ASKED_BY, TiledScene
from compgs.opening import component_bytes, open_scene
from compgs.scene.generated import generate_scene
from compgs.suites import jobs as jobs_module
from compgs.tiles import read_plan

STEPS = 12
OPTIONS = ["--preset", "quick", "--steps", str(STEPS), "--threads", "1"]


class InThisProcess:
    """What runs of tiles are done by: the arguments that they were given, and their exit codes."""

    def __init__(self) -> None:
        self.calls: list[list[str]] = []
        self.fails = False  # whether nothing is trained

    def __call__(self, arguments: list[str], log: Path) -> int:
        self.calls.append(list(arguments))
        log.write_text("")
        code = 1 if self.fails else main(list(arguments))
        if code == 130:
            raise KeyboardInterrupt
        if code:
            log.write_text("reading\nerror: no space\n")
        return code

    @property
    def tiles(self) -> list[str]:
        """Names of the tiles that were trained, in order."""
        return [Path(call[call.index("-o") + 1]).name for call in self.calls]


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> InThisProcess:
    """Starting an interpreter for each tile takes longer than training it."""
    here = InThisProcess()
    monkeypatch.setattr(jobs_module, "_run", here)
    monkeypatch.setenv(ASKED_BY, str(1 << 30))  # given back afterwards, whatever --memory sets
    return here


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "garden"
    generate_scene(folder, views=10, width=48, height=36)
    return folder


@pytest.fixture(scope="module")
def city(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished run in two tiles."""
    folder = tmp_path_factory.mktemp("runs") / "city"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jobs_module, "_run", InThisProcess())
        assert main(["tiles", str(scene), "-o", str(folder), "--grid", "2x1", *OPTIONS]) == 0
    return folder


def test_a_run_in_tiles_leaves_tiles_and_an_evaluation_of_all_together(city: Path) -> None:
    names = {str(path.relative_to(city)) for path in city.rglob("*") if path.is_file()}
    assert names >= {"city.tiles/manifest.json", "city.tiles/0_0.cgs", "city.tiles/1_0.cgs"}
    assert names >= {"plan.json", "config.json", "training.json", "results.json", "contact_sheet.png"}
    assert not [name for name in names if "partial" in name]
    results = json.loads((city / "results.json").read_text())
    assert results["file"] == "city.tiles" and results["views"] == 2
    assert results["bytes"] == sum(file.stat().st_size for file in (city / "city.tiles").iterdir())
    assert results["bytes"] == sum(results["components"].values())
    assert json.loads((city / "config.json").read_text())["tiles"] == "2x1"
    training = json.loads((city / "training.json").read_text())
    assert training["steps"] == 2 * STEPS and set(training["tiles"]) == {"0_0", "1_0"}
    assert not (city / "blocks" / "0_0" / "results.json").exists()


def test_anchors_of_a_tile_are_as_dense_as_its_own_points(city: Path) -> None:
    spacings = compgs.load_config("quick").model.voxel_spacings
    for tile in read_plan(city / "plan.json").tiles:
        model = open_scene(city / "city.tiles" / f"{tile.name}.cgs")
        assert model.primitives.voxel_size == pytest.approx(spacings * tile.spacing, rel=1e-12)


def test_every_anchor_lies_in_the_core_of_its_tile_and_no_place_is_twice(city: Path) -> None:
    plan = read_plan(city / "plan.json")
    manifest = read_manifest(city / "city.tiles" / "manifest.json")
    origin, axes = np.array(plan.ground.origin), np.array([plan.ground.right, plan.ground.forward])
    every = []
    for tile, entry in zip(plan.tiles, manifest.tiles, strict=True):
        assert entry.core == tile.core
        model = open_scene(city / "city.tiles" / entry.file)
        positions = model.primitives.positions.astype(np.float64) + np.array(model.world_offset)
        places = (positions - origin) @ axes.T
        assert len(places) > 50
        assert (places >= tile.core.low).all() and (places < tile.core.high).all()
        every.append(positions)
    together = np.concatenate(every)
    assert len(np.unique(together.round(9), axis=0)) == len(together)


def test_a_tile_was_trained_with_what_lies_beyond_its_core(city: Path) -> None:
    """Its checkpoint has anchors that its file does not have."""
    from compgs.training import load_run

    for name in ("0_0", "1_0"):
        written = open_scene(city / "city.tiles" / f"{name}.cgs").counts["anchors"]
        assert load_run(city / "blocks" / name).anchors > 1.2 * written


def test_a_finished_run_trains_nothing_again(city: Path, tmp_path: Path, runs: InThisProcess) -> None:
    copy = tmp_path / "city"
    shutil.copytree(city, copy)  # also where it has moved
    before = {path: path.stat().st_mtime_ns for path in copy.glob("blocks/*/*.cgs")}
    manifest = (copy / "city.tiles" / "manifest.json").read_bytes()
    assert main(["tiles", "-o", str(copy), "--resume", "--threads", "1"]) == 0
    assert runs.calls == []
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert (copy / "city.tiles" / "manifest.json").read_bytes() == manifest


def test_other_settings_train_anew(scene: Path, city: Path, tmp_path: Path, runs: InThisProcess) -> None:
    copy = tmp_path / "city"
    shutil.copytree(city, copy)
    again = ["tiles", str(scene), "-o", str(copy), "--grid", "2x1", "--overwrite", *OPTIONS]
    assert main([*again, "--steps", "5"]) == 0
    assert runs.tiles == ["0_0", "1_0"]
    assert json.loads((copy / "training.json").read_text())["steps"] == 10
    runs.calls.clear()
    runs.fails = True
    assert main([*again, "--steps", "5"]) == 1  # --overwrite: as if it had not been done
    assert runs.tiles == ["0_0", "1_0"]


@contextmanager
def stopping_at(step: int) -> Iterator[Callable]:
    def show(status) -> None:
        if status.step >= step:
            raise KeyboardInterrupt

    yield show


def test_a_run_that_is_stopped_in_a_tile_goes_on_there_and_comes_to_the_same_files(
    scene: Path,
    city: Path,
    tmp_path: Path,
    runs: InThisProcess,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = tmp_path / "city"
    with monkeypatch.context() as patch:
        whole, begun = train_command.training, []

        def second_stops():
            begun.append(1)
            return stopping_at(10) if len(begun) == 2 else whole()

        patch.setattr(train_command, "training", second_stops)
        assert main(["tiles", str(scene), "-o", str(folder), "--grid", "2x1", *OPTIONS]) == 130
    assert f"compgs tiles -o {folder} --resume" in capsys.readouterr().err
    assert (folder / "blocks" / "0_0" / "0_0.cgs").is_file()
    assert (folder / "blocks" / "1_0" / "checkpoint.safetensors").is_file()
    assert not (folder / "blocks" / "1_0" / "1_0.cgs").exists() and not (folder / "city.tiles").exists()
    code = main(["evaluate", str(folder)])
    assert code == 1 and "has not written manifest.json yet" in capsys.readouterr().err
    runs.calls.clear()
    assert main(["tiles", "-o", str(folder), "--resume", "--threads", "1"]) == 0
    assert runs.calls == [["train", "-o", str(folder / "blocks" / "1_0"), "--resume", "--threads", "1"]]
    for file in (city / "city.tiles").iterdir():
        assert (folder / "city.tiles" / file.name).read_bytes() == file.read_bytes()


def test_one_tile_alone_is_the_tile_of_all(city: Path, tmp_path: Path) -> None:
    alone = ["tiles", "--tile", f"{city / 'plan.json'}#1_0", "-o", str(tmp_path / "1_0"), "--threads", "1"]
    assert main(alone) == 0
    assert (tmp_path / "1_0" / "1_0.cgs").read_bytes() == (city / "city.tiles" / "1_0.cgs").read_bytes()


def test_the_run_of_a_tile_is_encoded_without_its_margins(city: Path, tmp_path: Path) -> None:
    assert main(["encode", str(city / "blocks" / "1_0"), "-o", str(tmp_path / "again.cgs")]) == 0
    assert (tmp_path / "again.cgs").read_bytes() == (city / "city.tiles" / "1_0.cgs").read_bytes()


def test_a_run_whose_settings_name_no_tiles_is_refused(city: Path, tmp_path: Path) -> None:
    for name, value in (("tiles", 2), ("tile", "0_0"), ("tile", {"name": "0_0"})):
        content = json.loads((city / "config.json").read_text())
        (tmp_path / "config.json").write_text(json.dumps({**content, "tiles": None, name: value}))
        (tmp_path / "checkpoint.safetensors").write_bytes(b"")
        assert main(["train", "-o", str(tmp_path), "--resume"]) == 1


def test_a_tile_that_fails_is_said_and_the_others_are_trained(
    scene: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    runs: InThisProcess,
) -> None:
    def run(arguments: list[str], log: Path) -> int:
        runs.fails = log.parent.name == "0_0"
        return runs(arguments, log)

    monkeypatch.setattr(jobs_module, "_run", run)
    folder = tmp_path / "city"
    assert main(["tiles", str(scene), "-o", str(folder), "--grid", "2x1", *OPTIONS]) == 1
    said = capsys.readouterr().err
    assert "1 of 2 tiles failed; tile 0_0: exit code 1: error: no space" in said
    assert (folder / "blocks" / "1_0" / "1_0.cgs").is_file() and not (folder / "city.tiles").exists()


@pytest.mark.slow
def test_commands_open_the_run_the_folder_and_the_manifest(
    city: Path, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], runs: InThisProcess
) -> None:
    tiles = city / "city.tiles"
    expected = json.loads((city / "results.json").read_text())
    for name, place in (
        ("run", [city]),
        ("folder", [tiles, scene]),
        ("file", [tiles / "manifest.json", scene]),
    ):
        output = tmp_path / name
        assert (
            main(["evaluate", *map(str, place), "-o", str(output), "--memory", "1kB", "--threads", "1"]) == 0
        )
        found = json.loads((output / "results.json").read_text())
        assert {k: found[k] for k in ("psnr", "ssim", "sha256")} == {
            k: expected[k] for k in ("psnr", "ssim", "sha256")
        }
        assert found["notes"] == []
    way = ["--frames", "2", "--width", "48", "--height", "36"]
    assert main(["render", str(tiles), "-o", str(tmp_path / "way"), *way]) == 0
    assert len(list((tmp_path / "way").glob("*.png"))) == 2
    capsys.readouterr()
    assert main(["info", str(city)]) == 0
    shown = capsys.readouterr().out
    assert f"2 tiles, {expected['bytes'] / 1000:.1f} kB" in shown and "1_0" in shown
    assert main(["decode", str(tiles), "-o", str(tmp_path / "arrays")]) == 0
    with np.load(tmp_path / "arrays" / "1_0" / "geometry.npz") as arrays:
        assert len(arrays["means"]) == read_manifest(tiles / "manifest.json").tiles[1].coupled_primitives
    capsys.readouterr()
    assert (
        main(["compare", str(tiles), str(tiles / "0_0.cgs"), "--memory", "1GB", "-o", str(tmp_path / "c")])
        == 0
    )
    compared = json.loads((tmp_path / "c" / "results.json").read_text())
    assert compared["a"]["file"] == "city.tiles" and compared["a"]["format"] == "tiles"
    assert compared["a"]["bytes"] == expected["bytes"] and not compared["identical"]


def test_what_tiles_cannot_be_taken_for_is_said(
    city: Path, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tiles = str(city / "city.tiles")
    for arguments, message in (
        (["export", tiles, str(tmp_path / "a.ply")], "tiles are exported one by one, as"),
        (["export", tiles, str(tmp_path / "a.html")], "a page shows a .cgs file, found a .tiles"),
        (["encode", tiles, "-o", str(tmp_path / "a.cgs"), "--drop", "0.1"], "has no checkpoint"),
        (["compress", tiles, "-o", str(tmp_path / "a.cgs")], "is compressed already"),
        (["decode", tiles, "--prefix", "1kB"], "is of a scene in tiles; give the file of one"),
        (["evaluate", tiles, str(scene), "--memory", "much"], "--memory much: expected a size"),
    ):
        assert main(arguments) in (1, 2)
        assert message in capsys.readouterr().err.replace("\n", " ")


def test_a_viewer_shows_tiles(city: Path) -> None:
    from compgs.viewer.shown import FileShown

    shown = FileShown(city / "city.tiles", "cpu")
    assert shown.title == "city.tiles" and len(shown.levels) == 1
    assert shown.levels[0].startswith("all of it: ")
    assert isinstance(shown.model(0), TiledScene)
    assert len(shown.cameras) == 8  # of the training, once, though both tiles have them
    assert sum(component_bytes(city / "city.tiles").values()) > 5000


@pytest.mark.slow
def test_two_tiles_at_once_on_a_cluster_are_those_of_one_after_the_other(
    scene: Path, city: Path, tmp_path: Path
) -> None:
    ray = pytest.importorskip("ray", reason="the extra `cluster` is not installed")
    stops = signal.getsignal(signal.SIGTERM)
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="error")
    try:
        options = ["--grid", "2x1", "--cluster", "local", *OPTIONS]
        assert main(["tiles", str(scene), "-o", str(tmp_path / "city"), *options]) == 0
    finally:
        ray.shutdown()
        signal.signal(signal.SIGTERM, stops)
    assert {json.loads(file.read_text())["tile"] for file in tmp_path.rglob("job.json")} == {"0_0", "1_0"}
    for file in (city / "city.tiles").iterdir():
        assert (tmp_path / "city" / "city.tiles" / file.name).read_bytes() == file.read_bytes()


def test_without_ray_the_remedy_is_said_before_anything_runs(
    scene: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    runs: InThisProcess,
) -> None:
    monkeypatch.setitem(extras.PACKAGES, "cluster", ("a_package_that_nobody_has",))
    options = ["--grid", "2x1", "--cluster", "local", *OPTIONS]
    assert main(["tiles", str(scene), "-o", str(tmp_path / "out"), *options]) == 1
    assert "pip install '.[cluster]'" in capsys.readouterr().err.replace("\n", " ")
    assert not (tmp_path / "out").exists() and not runs.calls


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--grid", "2"], "--grid 2: expected auto, or columns and rows"),
        (["--grid", "9x9"], "expected at least 100; use fewer tiles"),
        (["--grid", "2x1", "--cpus", "0"], "--cpus 0 --gpus 0: expected cores above 0"),
        (["--tile", "plan.json#0_0"], "takes the scene and settings from PLAN"),
    ],
)
def test_options_that_do_not_go_together_are_refused_before_anything_is_made(
    options: list[str],
    message: str,
    scene: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    runs: InThisProcess,
) -> None:
    assert main(["tiles", str(scene), "-o", str(tmp_path / "out"), *options, "--steps", "1"]) == 2
    assert message in capsys.readouterr().err.replace("\n", " ")
    assert not (tmp_path / "out").exists() and not runs.calls


def test_processes_of_a_torchrun_do_not_train_tiles(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("compgs.cli.tiles.several", lambda: True)
    assert main(["tiles", str(scene), "-o", str(tmp_path / "out"), "--grid", "2x1"]) == 2
    assert "torchrun's processes share one training" in capsys.readouterr().err.replace("\n", " ")


def test_tiles_on_a_cluster_share_the_cores_of_their_machines() -> None:
    assert Tiles(grid="2x1", threads=3).options_of_tiles() == ["--threads", "3"]
    assert Tiles(grid="2x1").options_of_tiles() == []
    away = Tiles(grid="2x1", cluster="local", cpus=2.5, device="cpu")
    assert away.options_of_tiles() == ["--threads", "2", "--device", "cpu"]


@pytest.mark.parametrize("options", [["-r", "2"], ["--grid", "2x1"], ["--steps", "5"], ["--preset", "quick"]])
def test_one_tile_has_the_settings_of_its_plan(
    options: list[str], city: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = f"{city / 'plan.json'}#0_0"
    assert main(["tiles", "--tile", place, "-o", str(tmp_path / "out"), *options]) == 2
    assert "takes the scene and settings from PLAN" in capsys.readouterr().err.replace("\n", " ")


def test_train_with_tiles_is_the_command_of_tiles() -> None:
    asked = parse(["train", "SCENE", "-o", "RUN", "--tiles", "2x1", "--steps", "9"])
    assert asked == Tiles(scene=Path("SCENE"), output=Path("RUN"), grid="2x1", steps=9)
    assert parse(["train", "--tile=p.json#0_0", "-o", "X"]) == Tiles(tile="p.json#0_0", output=Path("X"))
    assert isinstance(parse(["train", "SCENE", "-o", "RUN"]), Train)


@pytest.mark.parametrize(
    ("place", "code", "message"),
    [
        ("{city}/plan.json", 2, "expected the plan.json of a run and a tile"),
        ("{city}/plan.json#7_7", 2, "tile '7_7': not of the plan, which has 0_0, 1_0"),
        ("{city}/none.json#0_0", 1, "cannot be read"),
        ("{city}/config.json#0_0", 1, "not a plan of tiles"),
    ],
)
def test_a_tile_that_is_none_is_refused(
    place: str, code: int, message: str, city: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["tiles", "--tile", place.format(city=city), "-o", str(tmp_path / "out")]) == code
    assert message in capsys.readouterr().err.replace("\n", " ")


def test_a_run_goes_on_with_the_tiles_that_it_began_with(
    city: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["tiles", "-o", str(city), "--resume", "--grid", "3x1"]) == 2
    assert "--grid 3x1: the run to continue began with 2x1" in capsys.readouterr().err


def test_a_run_in_tiles_is_not_continued_as_one_training_nor_the_other_way_round(
    city: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", "-o", str(city), "--resume"]) == 2
    assert f"compgs tiles -o {city} --resume" in capsys.readouterr().err.replace("\n", " ")
    block = city / "blocks" / "0_0"
    assert main(["tiles", "-o", str(block), "--resume"]) == 2
    assert f"compgs train -o {block} --resume" in capsys.readouterr().err.replace("\n", " ")
