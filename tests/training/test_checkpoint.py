import signal
import time
from dataclasses import replace
from threading import Event

import pytest
import torch

from compgs.errors import CheckpointError, OutputError
from compgs.interrupt import Terminated, ended_on_request, held_back
from compgs.training.run import checkpoint as checkpoint_module
from compgs.training.run.checkpoint import (
    Writer,
    read_checkpoint_file,
    write_checkpoint_file,
)
from compgs.training.run.model_checkpoint import load_checkpoint
from compgs.training.run.pace import Pace
from compgs.training.trainer import Trainer

CPU = torch.device("cpu")


def same(a, b) -> bool:
    first, second = a.state_dict(), b.state_dict()
    return list(first) == list(second) and all(torch.equal(first[k], second[k]) for k in first)


def test_a_run_stopped_anywhere_continues_exactly(blob_scene, tiny_config, tmp_path):
    whole = Trainer(blob_scene, tiny_config, CPU)
    whole.run(None, None)
    for stop in (3, 17, 33):
        path = tmp_path / f"{stop}.safetensors"
        first = Trainer(blob_scene, tiny_config, CPU)
        for _ in range(stop):
            first.train_step()
        first.save(path)
        second = Trainer.resumed(blob_scene, path, tiny_config, CPU)
        assert second.step == stop
        second.run(None, None)
        assert same(whole.model, second.model), f"stopped at step {stop}"


def test_where_to_look_from_and_which_way_is_up_come_back(blob_scene, tiny_config, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    model = Trainer(blob_scene, tiny_config, CPU).model
    model.up = (0.0, 0.6, 0.8)
    trainer = Trainer(blob_scene, tiny_config, CPU, model)
    trainer.save(path)
    again = load_checkpoint(path).model
    assert again.angular_dilation == model.angular_dilation is not None
    assert again.up == (0.0, 0.6, 0.8)
    assert len(again.viewpoints) == len(model.viewpoints) > 0
    for mine, theirs in zip(model.viewpoints, again.viewpoints, strict=True):
        assert (mine.world_to_camera == theirs.world_to_camera).all()
        assert (mine.fx, mine.cy, mine.width) == (theirs.fx, theirs.cy, theirs.width)


def test_an_interrupt_leaves_a_checkpoint_of_the_last_whole_step(blob_scene, tiny_config, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    trainer = Trainer(blob_scene, tiny_config, CPU)

    def stop(status):
        if status.step == 20:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        trainer.run(path, stop)
    assert load_checkpoint(path).state["step"] == 20


def test_other_settings_are_refused_by_name(blob_scene, tiny_config, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    trainer = Trainer(blob_scene, tiny_config, CPU)
    trainer.train_step()
    trainer.save(path)
    other = replace(tiny_config, training=replace(tiny_config.training, lmbda=0.5))
    with pytest.raises(CheckpointError, match="lmbda"):
        Trainer.resumed(blob_scene, path, other, CPU)


def test_missing_and_damaged_checkpoints_are_named(tmp_path):
    with pytest.raises(CheckpointError, match="there is no checkpoint"):
        load_checkpoint(tmp_path / "nothing.safetensors")
    damaged = tmp_path / "damaged.safetensors"
    damaged.write_bytes(b"not safetensors at all")
    with pytest.raises(CheckpointError, match="damaged"):
        load_checkpoint(damaged)


def test_a_failed_write_keeps_the_previous_checkpoint(blob_scene, tiny_config, tmp_path, monkeypatch):
    import compgs.training.run.checkpoint as module
    from compgs.errors import OutputError

    path = tmp_path / "checkpoint.safetensors"
    trainer = Trainer(blob_scene, tiny_config, CPU)
    trainer.save(path)
    before = path.read_bytes()

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module.safetensors.torch, "save_file", full)
    with pytest.raises(OutputError, match="No space left"):
        trainer.save(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize(
    ("number", "kind"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated)]
)
def test_a_stop_inside_a_step_waits_for_its_end(number, kind):
    done = []
    with pytest.raises(kind) as stop, ended_on_request(), held_back():
        signal.raise_signal(number)
        signal.raise_signal(number)
        done.append("the rest of the step")
    assert stop.type is kind
    assert done == ["the rest of the step"]
    with held_back():
        done.append("no interrupt, no exception")
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_an_interrupt_that_is_ignored_stays_ignored():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with held_back():
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_second_ctrl_c_waits_for_the_checkpoint(blob_scene, tiny_config, tmp_path, monkeypatch):
    path = tmp_path / "checkpoint.safetensors"
    trainer = Trainer(blob_scene, tiny_config, CPU)
    save = trainer.save

    def impatient(where, writer):
        signal.raise_signal(signal.SIGINT)
        save(where, writer)

    monkeypatch.setattr(trainer, "save", impatient)

    def stop(status):
        if status.step == 10:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        trainer.run(path, stop)
    assert load_checkpoint(path).state["step"] == 10
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def stopped_at_10(status):
    if status.step >= 10:
        raise KeyboardInterrupt


def test_a_run_that_is_stopped_at_once_leaves_the_checkpoint_of_an_earlier_run(
    blob_scene, tiny_config, tmp_path
):
    path = tmp_path / "checkpoint.safetensors"
    path.write_bytes(b"of an earlier run")
    with pytest.raises(KeyboardInterrupt):
        Trainer(blob_scene, tiny_config, CPU).run(path, stopped_at_10)
    assert path.read_bytes() == b"of an earlier run"


def test_after_its_first_checkpoint_a_run_keeps_its_own(blob_scene, tiny_config, tmp_path, monkeypatch):
    path = tmp_path / "checkpoint.safetensors"
    path.write_bytes(b"of an earlier run")
    config = tiny_config
    monkeypatch.setattr("compgs.training.run.saving.MINUTES", 1e-9)
    found = {}

    def look(status):
        if path.read_bytes() != b"of an earlier run":
            found.setdefault(load_checkpoint(path).state["step"], status.step)
        if status.step >= 20:
            raise KeyboardInterrupt

    trainer = Trainer(blob_scene, config, CPU)
    step = trainer.train_step

    def slow_step():
        time.sleep(0.02)  # in which a checkpoint is written
        return step()

    monkeypatch.setattr(trainer, "train_step", slow_step)
    with pytest.raises(KeyboardInterrupt):
        trainer.run(path, look)
    assert len(found) >= 3
    late = [told - written for written, told in found.items()]
    assert sorted(late)[len(late) // 2] <= 3, "a report follows each checkpoint at once"
    assert load_checkpoint(path).state["step"] == 20


def test_a_continued_run_keeps_what_it_did_when_it_is_stopped_again(blob_scene, tiny_config, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    with pytest.raises(KeyboardInterrupt):
        Trainer(blob_scene, tiny_config, CPU).run(path, stopped_at_10)
    with pytest.raises(KeyboardInterrupt):
        Trainer.resumed(blob_scene, path, tiny_config, CPU).run(path, stopped_at_10)
    assert load_checkpoint(path).state["step"] == 20


def test_the_pace_is_that_of_the_steps_without_compilation_and_checkpoints(monkeypatch):
    now = 0.0
    monkeypatch.setattr("time.perf_counter", lambda: now)
    pace = Pace()

    def steps(count, seconds):
        nonlocal now
        for _ in range(count):
            now += seconds
            pace.step()

    steps(1, 30.0)
    assert pace.look() == 0.0
    steps(9, 0.1)
    assert pace.look() == pytest.approx(0.1)
    steps(10, 0.2)
    assert pace.look() == pytest.approx(0.11)
    now += 5.0
    pace.pause(5.0)
    steps(10, 0.11)
    assert pace.look() == pytest.approx(0.11)
    steps(10, 0.02)
    assert pace.look() == pytest.approx(0.02)


def test_what_was_read_does_not_hold_the_file(tmp_path):
    """A file that is mapped cannot be replaced on Windows; here its tensors would change with it."""
    path = tmp_path / "checkpoint.safetensors"
    write_checkpoint_file(path, "compgs", {"model/a": torch.arange(4096.0)}, {}, device=torch.device("cpu"))
    tensors, _ = read_checkpoint_file(path, "compgs")
    with path.open("r+b") as file:
        file.write(b"\0" * path.stat().st_size)
    assert torch.equal(tensors["model/a"], torch.arange(4096.0))


def test_a_checkpoint_beside_the_steps_is_of_the_step_at_which_it_was_begun(
    blob_scene, tiny_config, tmp_path, monkeypatch
):
    """The disk is slow: two steps are done before the file is begun."""
    trainer = Trainer(blob_scene, tiny_config, CPU)
    for _ in range(3):
        trainer.train_step()
    trainer.save(tmp_path / "at_once.safetensors")
    free = Event()
    save_file = checkpoint_module.safetensors.torch.save_file
    monkeypatch.setattr(
        checkpoint_module.safetensors.torch, "save_file", lambda *a, **k: free.wait(60) and save_file(*a, **k)
    )
    writer = Writer()
    trainer.save(tmp_path / "beside.safetensors", writer)
    for _ in range(2):
        trainer.train_step()
    assert writer.busy and not (tmp_path / "beside.safetensors").exists()
    free.set()
    writer.finish()
    (expected, told), (found, told_beside) = (
        read_checkpoint_file(tmp_path / name, "compgs")
        for name in ("at_once.safetensors", "beside.safetensors")
    )
    assert told == told_beside and expected.keys() == found.keys()
    assert all(torch.equal(value, found[name]) for name, value in expected.items())


def test_what_hinders_a_checkpoint_beside_the_steps_is_raised_by_the_run(
    blob_scene, tiny_config, tmp_path, monkeypatch
):
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint_module.safetensors.torch, "save_file", full)
    config = tiny_config
    monkeypatch.setattr("compgs.training.run.saving.MINUTES", 1e-9)
    trainer = Trainer(blob_scene, config, CPU)
    with pytest.raises(OutputError, match="No space left"):
        trainer.run(tmp_path / "run.safetensors", None)
    assert 0 < trainer.step < config.training.steps
