"""From a file of splats to a small file, and what is said of it."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import compgs
from compgs import metrics
from compgs.compressing import Looking, begin, compress, default_config, folder_of, pace, resumed
from compgs.compressing.compression import placed_cameras
from compgs.config import Config, ModelConfig, TrainingConfig
from compgs.errors import CheckpointError, ConfigError, NotACompGSFile, OutputError
from compgs.evaluation.camera_path import camera_entry, read_cameras
from compgs.formats import write_ply
from compgs.gaussians import Gaussians
from compgs.opening import open_scene
from compgs.render import render
from compgs.render.settings import RasterSettings
from compgs.tensors.reference import rasterize_reference
from compgs.training import Plan, TrainingStatus
from compgs.training.plan import Start, plan

LOOKING = Looking(views=10, held_out=3, width=48, height=36)


@pytest.fixture(scope="module")
def config() -> Config:
    small = ModelConfig(coupled_primitives=2, reference_dim=8, residual_dim=4, width=16)
    return Config(model=small, training=TrainingConfig(steps=30, viewpoints=2))


@pytest.fixture(scope="module")
def done(ball_ply: Path, config: Config, tmp_path_factory: pytest.TempPathFactory):
    output = tmp_path_factory.mktemp("done") / "ball.cgs"
    return compress(ball_ply, output, config=config, looking=LOOKING)


def test_the_file_decodes_and_its_quality_is_as_reported(done, ball_ply: Path) -> None:
    """Measured anew: both files opened, seen from the cameras that were written down, errors squared by hand."""
    ours, splats = compgs.decode(done.file), open_scene(ball_ply)
    found = []
    for _, camera in read_cameras(done.folder / "cameras.json"):
        pictures = [np.rint(np.clip(render(m, camera).image, 0, 1) * 255.0) for m in (ours, splats)]
        found.append(10 * np.log10(255**2 / np.mean((pictures[0] - pictures[1]) ** 2)))
    assert len(found) == 3
    np.testing.assert_allclose(done.results.psnr, np.mean(found), atol=1e-3)
    assert done.results.bytes == done.file.stat().st_size
    written = json.loads((done.folder / "results.json").read_text())
    np.testing.assert_allclose(written["psnr"], np.mean(found), atol=1e-3)
    assert (done.folder / "contact_sheet.png").is_file()


def test_other_formats_are_judged_by_the_same_measure(done, ball_ply: Path, tmp_path: Path) -> None:
    assert [each.format for each in done.others] == ["spz", "sog"]
    cameras = [camera for _, camera in read_cameras(done.folder / "cameras.json")]
    for each in done.others:
        path = tmp_path / f"ball.{each.format}"
        compgs.export(ball_ply, path)
        assert path.stat().st_size == each.bytes
        models = open_scene(path), open_scene(ball_ply)
        psnr = [metrics.psnr(*(metrics.to_8bit(render(m, c).image) for m in models)) for c in cameras]
        np.testing.assert_allclose(each.psnr, np.mean(psnr), atol=1e-6)
        assert each.psnr > 30 and 0.9 < each.ssim <= 1


def test_splats_that_another_format_cannot_hold_are_compressed_all_the_same(
    ball_ply: Path, config: Config, tmp_path: Path
) -> None:
    splats = open_scene(ball_ply).splats
    far = tmp_path / "far.ply"
    means = splats.means.copy()
    means[:9, 0] = 1e7  # beyond what 24 bits of .spz reach, and too many to be left out
    write_ply(replace(splats, means=means), far)
    done = compress(far, tmp_path / "far.cgs", config=config, looking=LOOKING)
    assert [each.format for each in done.others] == ["sog"]
    (note,) = done.notes
    assert note.startswith("the same splats as .spz: ") and "positions reach 1e+07" in note
    written = json.loads((done.folder / "results.json").read_text())["compress"]
    assert written["notes"] == [note] and [each["format"] for each in written["others"]] == ["sog"]


@pytest.mark.parametrize("antialiased", [False, True])
def test_what_is_trained_on_are_renderings_of_the_splats(
    ball_ply: Path, config: Config, tmp_path: Path, antialiased: bool
) -> None:
    looking = replace(LOOKING, views=4, held_out=2, background=(0.2, 0.5, 0.9))
    source = tmp_path / "source.ply"
    write_ply(replace(open_scene(ball_ply).splats, antialiased=antialiased), source)
    begun = begin(source, tmp_path / "out.cgs", config, looking)
    scene = begun.scene
    assert (len(scene.train_views), len(scene.test_views)) == (4, 2)
    settings = RasterSettings(background=looking.background, antialiased=antialiased)
    for view in (scene.train_views[1], scene.test_views[0]):
        arrays = vars(begun.splats.gaussians(view.camera)).values()
        gaussians = Gaussians(*map(torch.from_numpy, arrays))
        truth = metrics.to_8bit(rasterize_reference(gaussians, view.camera, settings).image.numpy())
        assert view.image.shape == (36, 48, 3)
        assert np.abs(view.image.astype(int) - truth.astype(int)).max() <= 1
        assert view.image is view.image  # kept


def test_a_run_that_was_stopped_goes_on_to_the_same_file(
    done, ball_ply: Path, config: Config, tmp_path: Path
) -> None:
    def stop(status: TrainingStatus) -> None:
        if status.step == 20:
            raise KeyboardInterrupt

    output = tmp_path / "stopped.cgs"
    with pytest.raises(KeyboardInterrupt):
        compress(ball_ply, output, config=config, looking=LOOKING, progress=stop)
    assert not output.exists()
    going = resumed(output)
    assert going.goes_on
    going.train()
    assert output.read_bytes() == done.file.read_bytes()


def test_other_splats_do_not_go_on(done, tmp_path: Path, ball_ply: Path) -> None:
    other = tmp_path / "other.ply"
    data = bytearray(ball_ply.read_bytes())
    data[-1] ^= 1
    other.write_bytes(data)
    with pytest.raises(CheckpointError, match=r"not the splats that .* was begun with"):
        resumed(done.file, other)
    with pytest.raises(CheckpointError, match="no compression to go on with"):
        resumed(tmp_path / "nothing.cgs")


def test_an_earlier_file_stays_until_the_new_one_is_whole(
    ball_ply: Path, config: Config, tmp_path: Path
) -> None:
    output = tmp_path / "out.cgs"
    output.write_bytes(b"earlier")
    with pytest.raises(OutputError, match="exists already"):
        compress(ball_ply, output, config=config, looking=LOOKING)
    begin(ball_ply, output, config, replace(LOOKING, views=2, held_out=1), overwrite=True)
    assert output.read_bytes() == b"earlier"


def test_given_cameras_are_split_as_scenes_are_and_more_come_between(ball, tmp_path: Path) -> None:
    placed = compgs.compressing.placing.place_cameras(ball.model, 18, 1)
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps([camera_entry(c, f"{i:03d}") for i, c in enumerate(placed.train)]))
    looking = replace(LOOKING, views=24, cameras=str(file))
    found = placed_cameras(ball.model, looking, 0)
    assert len(found.held_out) == 3 and len(found.train) == 24
    for i, camera in zip((0, 8, 16), found.held_out, strict=True):
        np.testing.assert_allclose(camera.world_to_camera, placed.train[i].world_to_camera)
        assert (camera.width, camera.height) == (48, 36)
    given = np.stack([camera.center for camera in placed.train])
    distances = np.linalg.norm(np.stack([c.center for c in found.train])[:, None] - given, axis=2).min(1)
    assert (distances < 1e-9).sum() == 15


def test_steps_are_as_many_as_fit_into_the_time(monkeypatch: pytest.MonkeyPatch, config: Config) -> None:
    monkeypatch.setattr(pace, "seconds_per_step", lambda *_: 0.05)
    monkeypatch.setattr(pace, "plan_for", lambda *_, **__: None)
    fitting = pace.steps_within(None, config, 100.0, None)
    assert abs(fitting.steps - 2000) < 20 and fitting.late == 0
    short = pace.steps_within(None, config, 2.0, None)
    assert short.steps == pace.FEWEST
    assert short.late == pytest.approx(0.05 * pace.FEWEST - 2.0, abs=0.2)


@dataclass(frozen=True)
class Views:
    """As much of a scene as a trial asks for."""

    train_views: tuple[int, ...]


@pytest.mark.parametrize(("seconds", "steps"), [(1e6, pace.TRIED), (200.0, 21), (5.0, pace.LEAST_TRIED)])
def test_a_trial_takes_a_part_of_the_time_only(
    monkeypatch: pytest.MonkeyPatch, config: Config, seconds: float, steps: int
) -> None:
    clock = [0.0]

    def train(scene, config, *, progress, **_):  # a step a second
        for step in range(1, config.training.steps + 1):
            clock[0] += 1.0
            progress(SimpleNamespace(step=step, seconds_per_step=1.0))

    monkeypatch.setattr(pace.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(pace, "train", train)
    start = Start(1000, 1, 1.0, 1.0, 0.002, 1728, "cpu")
    assert pace.seconds_per_step(Views((0,)), config, "cpu", plan(config, start), seconds) == 1.0
    assert clock[0] == steps


@pytest.mark.parametrize("until", [0.0, 0.4, 1.0])
def test_a_run_s_pace_is_that_of_coarse_and_whole_photographs_by_their_shares(until: float) -> None:
    """Steps of 1 s on coarse photographs, 3 s on whole ones; the first ten took a minute."""
    told, now = [], 60.0
    for step in range(10, 61):
        now += 0.0 if step == 10 else 1.0 if step <= until * 60 else 3.0
        if step % 10 == 0:
            told.append((step, now))
    assert pace.mean_pace(told, until, 60) == pytest.approx(until * 1.0 + (1.0 - until) * 3.0)
    assert pace.mean_pace(told[:2], until, 60) == pytest.approx(3.0 if until == 0 else 1.0)
    assert pace.mean_pace(told[:1], until, 60) is None


def test_a_step_takes_longer_in_a_run_that_looks_for_points(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[Plan] = []

    def train(*_, progress, plan, **__):
        asked.append(plan)
        progress(SimpleNamespace(step=1, seconds_per_step=1.0))

    monkeypatch.setattr(pace, "train", train)
    dense = plan(Config(), Start(50_000, 100, 20.0, 30.0, 0.002, 86_400, "cpu", findable=100_000))
    assert dense.dense_points > 0
    took = pace.seconds_per_step(Views((0,)), Config(), "cpu", dense)
    assert took == pytest.approx(1.0 + 2.0 * pace.FOR_POINTS)
    assert asked == [replace(dense, dense_points=0.0)]  # none are looked for in a trial
    sparse = replace(dense, dense_points=0.0)
    assert pace.seconds_per_step(Views((0,)), Config(), "cpu", sparse) == pytest.approx(1.0)


def test_a_time_is_kept_and_its_steps_are_written_down(
    monkeypatch: pytest.MonkeyPatch, ball_ply: Path, config: Config, tmp_path: Path
) -> None:
    monkeypatch.setattr(pace, "FEWEST", 7)
    begun = begin(ball_ply, tmp_path / "out.cgs", config, replace(LOOKING, views=3, held_out=1), seconds=1e-3)
    assert begun.begun.config.training.steps == 7
    again = json.loads((folder_of(tmp_path / "out.cgs") / "compress.json").read_text())
    assert again["settings"]["training"]["steps"] == 7


def test_a_trial_has_the_rate_in_every_step_and_nothing_else(config: Config) -> None:
    trial = pace.trial(default_config())
    assert trial.training.borders.rate == 0 and trial.training.target_bytes is None
    assert trial.control.prune_at == () and trial.entropy.decorrelate_at == ()


@pytest.mark.parametrize(
    ("arguments", "kind", "message"),
    [
        ({"looking": Looking(views=1)}, ConfigError, "views = 1: expected 2"),
        ({"looking": Looking(width=2)}, ConfigError, "width = 2"),
        ({"looking": Looking(up=(0, 0, 0))}, ConfigError, "expected a direction"),
        ({"looking": Looking(background=(0, 0, 2))}, ConfigError, "from 0 to 1"),
        ({"seconds": -1.0}, ConfigError, "expected more than none"),
        ({"preset": "quick", "config": Config()}, ConfigError, "give one"),
        ({"preset": "fast"}, ConfigError, "does not exist"),
        ({"output": "out.ply"}, OutputError, r"ends in \.cgs"),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(
    ball_ply: Path, tmp_path: Path, arguments: dict, kind: type[Exception], message: str
) -> None:
    output = tmp_path / arguments.pop("output", "out.cgs")
    with pytest.raises(kind, match=message) as error:
        compress(ball_ply, output, **arguments)
    assert "\n" not in str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_a_cgs_file_is_not_compressed_again(tiny_cgs: Path, tmp_path: Path) -> None:
    with pytest.raises(NotACompGSFile, match="is compressed already"):
        compress(tiny_cgs, tmp_path / "out.cgs", looking=LOOKING)


def test_splats_far_from_the_origin_are_compressed_there(ball, config: Config, tmp_path: Path) -> None:
    from compgs.formats import write_ply

    source = tmp_path / "far.ply"
    write_ply(ball.model.at((65536.0, 0.0, -131072.0)).splats, source)
    output = tmp_path / "far.cgs"
    short = replace(config, training=replace(config.training, steps=3))
    begun = begin(source, output, short, replace(LOOKING, views=3, held_out=1))
    begun.train()
    centers = np.stack([c.center for c in compgs.decode(output).viewpoints])
    assert np.linalg.norm(centers - [65539, 0, -131072], axis=1).max() < 5
    assert np.isfinite(compgs.decode(output).bounds[0]).all()
