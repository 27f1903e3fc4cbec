"""What somebody writes who has read the first page only: models, scenes and folders are taken where they make sense."""

from pathlib import Path

import numpy as np
import pytest

import compgs
from compgs.config import load_config
from compgs.errors import ConfigError, SceneError
from compgs.scene import as_scene
from compgs.scene.generated import generate_scene
from compgs.scene.views import Scene
from compgs.training import Trainer, train_splats
from compgs.training.run.run import chosen_config, chosen_device

GOLDEN = Path(__file__).parent / "golden" / "trained.cgs"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "scene"
    generate_scene(folder, views=9, width=32, height=24)
    return folder


@pytest.fixture(scope="module")
def scene(folder: Path) -> Scene:
    return compgs.load_scene(folder)


def test_a_model_is_rendered_as_its_file_would_be(scene: Scene) -> None:
    model = Trainer(scene, load_config("quick"), chosen_device("cpu")).model
    camera = scene.test_views[0].camera
    image = compgs.render(model, camera).image
    assert image.shape == (24, 32, 3) and image.std() > 0
    np.testing.assert_array_equal(image, compgs.render(model.as_hybrid_model(), camera).image)


@pytest.mark.parametrize("model", ["garden.cgs", None])
def test_what_is_no_model_is_not_rendered(scene: Scene, model: object) -> None:
    with pytest.raises(
        ConfigError, match=r"expected what compgs.train or compgs.decode gives, found (str|NoneType)"
    ):
        compgs.render(model, scene.test_views[0].camera)  # type: ignore[arg-type]


def test_a_folder_is_as_good_as_the_scene_in_it(folder: Path, scene: Scene) -> None:
    assert as_scene(scene) is scene
    for path in (folder, str(folder)):
        read = as_scene(path)
        assert [view.name for view in read.test_views] == [view.name for view in scene.test_views]


@pytest.mark.parametrize("train", [compgs.train, train_splats])
def test_training_takes_a_folder_and_says_what_else_it_takes(tmp_path: Path, train) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(SceneError, match="nowhere"):
        train(str(tmp_path / "nowhere"))
    with pytest.raises(
        ConfigError, match=r"expected what compgs.load_scene gives, or the folder .*, found list"
    ):
        train([])
    with pytest.raises(ConfigError, match="give one"):
        train(tmp_path, load_config("quick"), preset="paper")
    with pytest.raises(ConfigError, match="preset='quick'"):
        train(tmp_path, "quick")


def test_evaluation_takes_a_folder_and_says_what_else_it_takes(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="nowhere"):
        compgs.evaluate(tmp_path / "a.cgs", tmp_path / "nowhere")
    with pytest.raises(ConfigError, match="found int"):
        compgs.evaluate(tmp_path / "a.cgs", 3)  # type: ignore[arg-type]


def test_settings_are_those_of_the_config_or_of_the_preset() -> None:
    assert chosen_config(None, None) == load_config("default")
    assert chosen_config(None, "quick") == chosen_config(load_config("quick"), None) == load_config("quick")
    with pytest.raises(ConfigError, match=r"config and preset='paper' were both given"):
        chosen_config(load_config("quick"), "paper")


NO_PATHS = {
    "decode": lambda given, scene: compgs.decode(given),
    "open_scene": lambda given, scene: compgs.open_scene(given),
    "load_scene": lambda given, scene: compgs.load_scene(given),
    "export": lambda given, scene: compgs.export(GOLDEN, given),
    "evaluate": lambda given, scene: compgs.evaluate(given, scene),
    "evaluate, output": lambda given, scene: compgs.evaluate(GOLDEN, scene, output=given),
    "compare": lambda given, scene: compgs.compare(given, GOLDEN),
    "compare, b": lambda given, scene: compgs.compare(GOLDEN, given),
    "report": lambda given, scene: compgs.report(given, "report.html"),
    "report, one of them": lambda given, scene: compgs.report([given], "report.html"),
    "report, output": lambda given, scene: compgs.report([], given),
    "compress": lambda given, scene: compgs.compress(given, "splats.cgs"),
    "compress, output": lambda given, scene: compgs.compress(GOLDEN, given),
    "train, output": lambda given, scene: compgs.train(scene, output=given, steps=1),
    "train, splats": lambda given, scene: compgs.train(scene, method="spz", splats=given, steps=1),
}


@pytest.mark.parametrize("call", NO_PATHS.values(), ids=list(NO_PATHS))
def test_what_is_no_path_is_refused_with_what_was_expected(
    call, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.chdir(tmp_path)
    for given in (3, compgs.decode(GOLDEN)):
        with pytest.raises(
            ConfigError, match=rf"expected the path of a (file|folder|run), found {type(given).__name__}"
        ):
            call(given, scene)
    assert list(tmp_path.iterdir()) == []


def test_a_model_that_is_no_path_is_told_the_way_to_one(scene: Scene) -> None:
    trained = Trainer(scene, load_config("quick"), chosen_device("cpu")).model
    with pytest.raises(ConfigError, match=r"compgs.encode\(model, 'scene.cgs'\) writes the file"):
        compgs.evaluate(trained, scene)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="give the path that it was opened from"):
        compgs.evaluate(compgs.decode(GOLDEN), scene)  # type: ignore[arg-type]
