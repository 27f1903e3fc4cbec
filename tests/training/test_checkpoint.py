from dataclasses import replace

import pytest
import torch

from compgs.errors import CheckpointError
from compgs.training.checkpoint import load_checkpoint
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
        second = Trainer.resumed(blob_scene, load_checkpoint(path), tiny_config, CPU)
        assert second.step == stop
        second.run(None, None)
        assert same(whole.model, second.model), f"stopped at step {stop}"


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
        Trainer.resumed(blob_scene, load_checkpoint(path), other, CPU)


def test_missing_and_damaged_checkpoints_are_named(tmp_path):
    with pytest.raises(CheckpointError, match="there is no checkpoint"):
        load_checkpoint(tmp_path / "nothing.safetensors")
    damaged = tmp_path / "damaged.safetensors"
    damaged.write_bytes(b"not safetensors at all")
    with pytest.raises(CheckpointError, match="damaged"):
        load_checkpoint(damaged)


def test_a_failed_write_keeps_the_previous_checkpoint(blob_scene, tiny_config, tmp_path, monkeypatch):
    import compgs.training.checkpoint as module
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


def test_ctrl_c_inside_a_step_waits_for_its_end():
    import signal

    from compgs.training.interrupt import held_back

    done = []
    with pytest.raises(KeyboardInterrupt), held_back():
        signal.raise_signal(signal.SIGINT)
        done.append("the rest of the step")
    assert done == ["the rest of the step"]
    with held_back():
        done.append("no interrupt, no exception")
