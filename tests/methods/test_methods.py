"""Every method trains, stops and goes on, writes a file, and the file is opened by its first bytes."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import compgs
from compgs.cli import training_command as train_command
from compgs.cli.main import main
from compgs.config import Config, SplatConfig, TrainingConfig
from compgs.errors import CheckpointError, ConfigError, SplatFileError
from compgs.formats import write_ply
from compgs.formats.packed import SUFFIX
from compgs.methods import METHODS, settings_of, train, write
from compgs.model.splats import SplatModel
from compgs.opening import component_bytes, open_scene
from compgs.published import READERS
from compgs.render import render
from compgs.scene.generated import generate_scene
from compgs.scene.views import Points, Scene
from compgs.training.run.checkpoint import read_checkpoint_file

STEPS = 40
OF_SPLATS = ("3dgs", "spz", "sog", "toy")


def quick(method: str, **splats: Any) -> Any:
    """A run that goes through growth."""
    kind = settings_of(method)
    return replace(
        kind,
        splats=SplatConfig(densify_every=0.2, densify_stop=0.9, gradient_threshold=1e-5, **splats),
        training=TrainingConfig(steps=STEPS, seed=3),
    )


@pytest.fixture(scope="module")
def trained(blob_scene: Scene) -> SplatModel:
    return train(blob_scene, quick("3dgs"), method="3dgs", device="cpu")


def test_the_registry_says_what_a_reader_needs_to_know() -> None:
    assert list(METHODS)[:4] == ["compgs", "3dgs", "spz", "sog"]
    for name, method in METHODS.items():
        assert name == method.name and method.suffix.startswith(".")
        assert (name in READERS) == (method.suffix == SUFFIX)
        assert method.description and method.reference
        assert isinstance(settings_of(name), method.settings)


def test_training_by_name_is_training_by_the_function(blob_scene: Scene, trained: SplatModel) -> None:
    again = compgs.training.train_splats(blob_scene, quick("3dgs"), device="cpu")  # type: ignore[attr-defined]
    assert np.array_equal(trained.splats.means, again.splats.means)
    assert len(trained.splats) != len(blob_scene.points), "nothing grew: the test is too weak"


@pytest.mark.parametrize("method", ["spz", "sog"])
def test_the_files_of_plain_splats_show_what_was_trained(
    method: str, blob_scene: Scene, trained: SplatModel, tmp_path: Path
) -> None:
    given = train(blob_scene, quick(method), method=method, splats=trained, output=tmp_path, device="cpu")
    assert np.array_equal(given.splats.dc, trained.splats.dc), "splats that were given are not trained"
    path = tmp_path / f"a{METHODS[method].suffix}"
    assert write(given, path, method=method) == path.stat().st_size < 60 * len(trained.splats)
    again = open_scene(path)
    camera = blob_scene.test_views[0].camera
    difference = render(again, camera).image - render(trained, camera).image
    assert again.counts == trained.counts and np.abs(difference).mean() < 0.01
    _, metadata = read_checkpoint_file(tmp_path / "checkpoint.safetensors", method)
    assert metadata["method"] == method


def test_a_method_with_hooks_phases_and_a_container_shows_what_it_trained(
    blob_scene: Scene, tmp_path: Path
) -> None:
    seen = []
    result = train(blob_scene, quick("toy"), method="toy", device="cpu", progress=seen.append)
    model, colors = result
    assert len(model.splats) == len(colors.labels) != len(blob_scene.points)
    assert [(s.step, s.steps) for s in seen] == [(10 * i, 60) for i in range(1, 7)]
    path = tmp_path / "a.packed"
    assert write(result, path, method="toy") == path.stat().st_size == sum(component_bytes(path).values())
    assert component_bytes(path)["labels"] <= -(-3 * len(model.splats) // 8)
    opened = open_scene(path, background=model.background)
    assert isinstance(opened, SplatModel) and len(np.unique(opened.splats.dc, axis=0)) <= 8
    camera = blob_scene.test_views[0].camera
    drawn = replace(model, splats=replace(model.splats, dc=colors.palette.detach()[colors.labels]))
    assert np.array_equal(render(opened, camera).image, render(drawn, camera).image)


@pytest.mark.parametrize("stop", [20, 40, 50])
def test_a_run_with_hooks_that_was_stopped_in_any_phase_continues_exactly(
    stop: int, blob_scene: Scene, tmp_path: Path
) -> None:
    def stopped(status: Any) -> None:
        if status.step == stop:
            raise KeyboardInterrupt

    whole, path = train(blob_scene, quick("toy"), method="toy", device="cpu"), tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        train(blob_scene, quick("toy"), method="toy", device="cpu", output=path, progress=stopped)
    again = train(blob_scene, quick("toy"), method="toy", device="cpu", output=path, resume=True)
    write(whole, tmp_path / "a", method="toy")
    write(again, tmp_path / "b", method="toy")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    # A finished run gives the same again.
    again = train(blob_scene, quick("toy"), method="toy", device="cpu", output=path, resume=True)
    write(again, tmp_path / "b", method="toy")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_a_penalty_of_a_hook_is_felt(blob_scene: Scene) -> None:
    light, heavy = (
        train(
            blob_scene, replace(quick("toy"), toy=settings_of("toy", preset).toy), method="toy", device="cpu"
        )[0]
        for preset in ("default", "heavy")
    )
    assert heavy.splats.opacity_logits.mean() < light.splats.opacity_logits.mean() - 0.01


def test_splats_take_the_place_of_the_first_phase(
    blob_scene: Scene, trained: SplatModel, tmp_path: Path
) -> None:
    file = tmp_path / "a.ply"
    write_ply(trained.splats, file)
    model, colors = train(blob_scene, quick("toy"), method="toy", splats=file, device="cpu")
    assert len(model.splats) == len(trained.splats) == len(colors.labels)
    moved = np.abs(model.splats.means - trained.splats.means)
    assert 0 < moved.max() < 0.01


def test_what_a_method_cannot_begin_with_is_refused(
    blob_scene: Scene, trained: SplatModel, tmp_path: Path, tiny_cgs: Path
) -> None:
    with pytest.raises(ConfigError, match="method 'gs' does not exist; there are compgs, 3dgs"):
        train(blob_scene, method="gs")
    with pytest.raises(ConfigError, match="method compgs does not begin with plain 3DGS"):
        train(blob_scene, method="compgs", splats=trained)
    with pytest.raises(ConfigError, match="expected a file of splats"):
        train(blob_scene, method="spz", splats=tiny_cgs)
    with pytest.raises(ConfigError, match=r"compgs\.methods\.settings_of\('toy'\)"):
        train(blob_scene, Config(), method="toy")
    with pytest.raises(ConfigError, match=r"preset 'x' of method toy .* default, paper, quick, heavy"):
        settings_of("toy", "x")
    far = replace(
        blob_scene,
        train_views=tuple(
            replace(v, camera=v.camera.moved((-1e6, 0.0, 0.0))) for v in blob_scene.train_views
        ),
    )
    with pytest.raises(ConfigError, match=r"a \.spz file cannot say where"):
        train(far, method="spz")


@pytest.mark.parametrize("method", ["compact3d", "c3dgs", "lightgaussian"])
def test_files_of_methods_say_where_their_positions_count_from(
    method: str, blob_scene: Scene, tmp_path: Path
) -> None:
    def moved(views: tuple[Any, ...]) -> tuple[Any, ...]:
        return tuple(replace(v, camera=v.camera.moved((-1e6, 0.0, 0.0))) for v in views)

    points = Points(blob_scene.points.positions + np.array([1e6, 0.0, 0.0]), blob_scene.points.colors)
    far = replace(
        blob_scene,
        train_views=moved(blob_scene.train_views),
        test_views=moved(blob_scene.test_views),
        points=points,
    )
    path = tmp_path / "a.packed"
    shown = []
    for scene in (blob_scene, far):
        write(train(scene, quick(method), method=method, device="cpu"), path, method=method)
        shown.append(render(open_scene(path), scene.test_views[0].camera).image)
    assert open_scene(path).world_offset[0] > 9e5
    # Two trainings that round differently: alike, as pictures of different places would not be.
    assert shown[0].mean() > 0.03
    assert np.corrcoef(shown[0].ravel(), shown[1].ravel())[0, 1] > 0.8


def test_a_checkpoint_of_another_method_is_not_continued(blob_scene: Scene, tmp_path: Path) -> None:
    train(blob_scene, quick("3dgs"), method="3dgs", output=tmp_path, device="cpu")
    with pytest.raises(CheckpointError, match="a run of method 3dgs, expected one of method spz"):
        train(blob_scene, quick("spz"), method="spz", output=tmp_path, resume=True, device="cpu")


def test_damaged_content_of_a_method_is_named(blob_scene: Scene, tmp_path: Path) -> None:
    from compgs.formats.packed import Packed, write_packed

    path = tmp_path / "a.packed"
    write_packed(path, Packed("toy", {}, {"means": np.zeros((4, 2), np.float32)}))
    with pytest.raises(SplatFileError, match=r"a\.packed: means: expected float32 of shape \(any, 3\)"):
        open_scene(path)
    write_packed(path, Packed("compgs", {}, {}))
    with pytest.raises(SplatFileError, match=r"a file of method compgs; known here are those of .*toy"):
        open_scene(path)


def test_a_run_of_any_method_is_a_folder_that_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, run, other = tmp_path / "scene", tmp_path / "run", tmp_path / "other"
    generate_scene(scene, views=9, width=32, height=24)
    options = ["--method", "toy", "--preset", "heavy", "--steps", "20", "--set", "toy.tuned=0.25"]

    @contextmanager
    def stopped_on_the_way() -> Iterator[Any]:
        def stop(status: Any) -> None:
            raise KeyboardInterrupt

        yield stop

    with monkeypatch.context() as patch:
        patch.setattr(train_command, "training", stopped_on_the_way)
        assert main(["train", str(scene), "-o", str(run), *options]) == 130
    assert main(["train", "-o", str(run), "--resume"]) == 0
    config = json.loads((run / "config.json").read_text())
    assert (config["method"], config["settings"]["toy"]) == ("toy", {"tuned": 0.25, "weight": 1.0})
    results = json.loads((run / "results.json").read_text())
    assert (results["method"], results["file"]) == ("toy", "run.packed")
    assert results["bytes"] == (run / "run.packed").stat().st_size == sum(results["components"].values())
    facts = json.loads((run / "training.json").read_text())
    assert facts["method"] == "toy" and 0 < facts["encode_seconds"] < 60
    given = ["--method", "spz", "--from-splats", str(run / "run.packed")]
    assert main(["train", str(scene), "-o", str(other), *given]) == 0
    theirs = json.loads((other / "results.json").read_text())
    assert (theirs["method"], theirs["splats"]) == ("spz", results["splats"])
    assert json.loads((other / "config.json").read_text())["from_splats"] == str(run / "run.packed")
    assert main(["train", "-o", str(other), "--resume"]) == 0
    assert json.loads((other / "results.json").read_text())["sha256"] == theirs["sha256"]
    capsys.readouterr()
    for wrong, message in (
        (["--method", "gs"], "--method gs: expected one of compgs, 3dgs"),
        (["--from-splats", str(run / "run.packed")], "--from-splats: --method compgs does not begin"),
        (["--method", "toy", "--lmbda", "1"], "--lmbda: not a setting of --method toy"),
        (["--method", "toy", "--set", "toy.tuned=2"], "toy.tuned=2.0: expected above 0, up to 1"),
        (["--method", "toy", "--preset", "x"], "default, paper, quick, heavy"),
        (["--method", "spz", "--from-splats", str(scene)], "expected a .cgs file or one of"),
    ):
        assert main(["train", str(scene), "-o", str(tmp_path / "none"), *wrong]) != 0
        assert message in " ".join(capsys.readouterr().err.split())
