"""Two ranks with one view each, against one with two views a step: the same sums in another order."""

import contextlib
import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from compgs.cli.console import say
from compgs.cli.ranks import among_ranks
from compgs.config import Config
from compgs.errors import ConfigError, TrainingError
from compgs.scene.views import Scene
from compgs.training.run import distributed
from compgs.training.trainer import Trainer

SCRIPT = Path(__file__).with_name("ranks.py")
KINDS = ("compgs", "3dgs")
TOLERANCE = 2e-5  # of the largest number: what another order of a sum changes


def quiet_environment() -> dict[str, str]:
    kept = {k: v for k, v in os.environ.items() if not k.startswith("COV")}
    return {**kept, "NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo"}


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What one process finds, and two that share its work."""
    folder = tmp_path_factory.mktemp("ranks")
    results: dict[str, Any] = {}
    for name, of in (("alone", 1), ("together", 2)):
        place = folder / name
        place.mkdir()
        if of > 1:
            (place / "scene").symlink_to(folder / "alone" / "scene")
        processes = [
            subprocess.Popen(
                [sys.executable, str(SCRIPT), str(rank), str(of), str(place)],
                env=quiet_environment(),
                stderr=subprocess.PIPE,
                text=True,
            )
            for rank in range(of)
        ]
        said = [process.communicate(timeout=240)[1] for process in processes]
        assert processes[0].returncode == 0, said
        results[name] = [torch.load(place / f"found_{r}.pt", weights_only=False) for r in range(of)]
    return results


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.slow
def test_two_ranks_with_a_view_each_have_the_gradients_of_one_with_two_views(
    found: dict[str, Any], kind: str
) -> None:
    alone = found["alone"][0][f"gradients {kind}"]
    for rank in found["together"]:
        shared = rank[f"gradients {kind}"]
        assert shared.keys() == alone.keys()
        for name, expected in alone.items():
            assert (shared[name] - expected).abs().max() <= TOLERANCE * expected.abs().max(), name


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.slow
def test_ranks_stay_identical_to_the_last_bit_and_near_the_run_of_one(
    found: dict[str, Any], kind: str
) -> None:
    """Near: rounding decides which primitives are drawn at all, so that only the run as a whole can be compared."""
    first, second = (rank[f"run {kind}"] for rank in found["together"])
    for name, value in first["parameters"].items():
        assert torch.equal(value, second["parameters"][name]), name
    assert torch.equal(first["exposures"], second["exposures"]) and first["exposures"].any()
    alone = found["alone"][0][f"run {kind}"]
    assert len(set(alone["counts"])) > 1, "it grew"
    assert first["counts"][: len(alone["counts"])] == pytest.approx(alone["counts"], rel=0.02)
    assert first["primitives"] == pytest.approx(alone["primitives"], rel=0.05)
    torch.testing.assert_close(first["exposures"], alone["exposures"], rtol=0.1, atol=0.02)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.slow
def test_no_rank_reads_the_photographs_of_another(found: dict[str, Any], kind: str) -> None:
    first, second = (rank[f"run {kind}"]["seen"] for rank in found["together"])
    assert len(first) == len(second) == 4 and not first & second
    assert found["alone"][0][f"run {kind}"]["seen"] == first | second


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.slow
def test_the_checkpoint_of_one_process_goes_on_with_two(found: dict[str, Any], kind: str) -> None:
    first, second = (rank[f"resumed {kind}"] for rank in found["together"])
    alone = found["alone"][0][f"resumed {kind}"]
    for name, value in first["parameters"].items():
        assert torch.equal(value, second["parameters"][name]), name
    assert first["primitives"] == pytest.approx(alone["primitives"], rel=0.05)
    assert torch.equal(
        torch.tensor(alone["primitives"]), torch.tensor(found["alone"][0][f"run {kind}"]["primitives"])
    )
    for name, expected in alone["statistics"].items():
        assert torch.equal(first["statistics"][name] + second["statistics"][name], expected), name


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.slow
def test_the_checkpoint_of_two_processes_goes_on_with_one(
    found: dict[str, Any], kind: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Its statistics are those of both."""
    sys.path.append(str(SCRIPT.parent))
    from ranks import CONFIG, CPU, STOPPED_AT, TRAINERS, small_scene

    folder = next(tmp_path_factory.getbasetemp().glob("ranks*"))
    scene = small_scene(folder / "alone" / "scene")
    trainer = TRAINERS[kind].resumed(scene, folder / "together" / f"{kind}.safetensors", CONFIG, CPU)
    alone = TRAINERS[kind].resumed(scene, folder / "alone" / f"{kind}.safetensors", CONFIG, CPU)
    assert trainer.step == alone.step == STOPPED_AT
    if trainer.primitives == alone.primitives:
        for name in trainer.control.STATISTICS:
            mine, theirs = (float(getattr(t.control, name).double().sum()) for t in (trainer, alone))
            assert mine == pytest.approx(theirs, rel=0.02), name
    trainer.run(None, None)
    assert trainer.primitives == pytest.approx(found["alone"][0][f"run {kind}"]["primitives"], rel=0.05)


@pytest.mark.slow
def test_ranks_that_have_come_apart_are_told_with_rank_step_and_name(found: dict[str, Any]) -> None:
    for rank in found["together"]:
        assert rank["diverging"].startswith(
            "TrainingError: step 0: rank 1 of 2 holds other values of log_scales"
        )


@pytest.mark.slow
def test_ctrl_c_at_one_rank_stops_all_after_the_same_step_with_a_checkpoint(found: dict[str, Any]) -> None:
    assert [rank["stopped"]["step"] for rank in found["together"]] == [6, 6]
    assert found["together"][0]["stopped"]["written"]


@pytest.mark.slow
def test_a_rank_without_a_view_is_refused_with_the_remedy(found: dict[str, Any]) -> None:
    for rank in found["together"]:
        assert "views_per_step = 1: 2 processes need a view each; set it to 2" in rank["too few views"]


@pytest.mark.slow
def test_a_rank_that_ends_ends_the_others_with_one_line(found: dict[str, Any]) -> None:
    said = found["together"][0]["gone"]
    assert said.startswith("TrainingError: rank 0 of 2: another rank has ended or cannot be reached")
    assert "\n" not in said


def test_alone_nothing_is_sent_and_nothing_changes(blob_scene: Scene, tiny_config: Config) -> None:
    trainer = Trainer(blob_scene, tiny_config, torch.device("cpu"))
    assert (distributed.world(), distributed.rank(), distributed.share_of_rank([4, 5])) == (1, 0, [4, 5])
    assert distributed.on_any_rank(True, False) == (True, False)
    trainer.control.seen += 3
    with distributed.summed_over_ranks(trainer.control, ["seen"]):
        pass
    distributed.keep_on_rank_zero(trainer.control, ["seen"])
    assert (trainer.control.seen == 3).all()
    parameter = torch.nn.Parameter(torch.zeros(2))
    distributed.sum_gradients([parameter])
    assert parameter.grad is None
    distributed.check_identical(0, {"a": parameter})


@pytest.mark.slow
def test_torchrun_trains_one_file_and_says_everything_once(tmp_path: Path, found: dict[str, Any]) -> None:
    """The command as it is typed, but for torchrun's own work: two processes with its variables."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    scene = next((tmp_path.parent).glob("ranks*/alone/scene"))
    command = [
        *(sys.executable, "-m", "compgs", "train", str(scene), "-o", str(tmp_path / "run"), "--steps", "6"),
        *("--device", "cpu", "--set", "training.views_per_step=2"),
    ]
    variables = {
        "WORLD_SIZE": "2",
        "LOCAL_WORLD_SIZE": "2",
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
    }
    processes = [
        subprocess.Popen(
            command,
            env={**quiet_environment(), **variables, "RANK": str(rank), "LOCAL_RANK": str(rank)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in range(2)
    ]
    (out, errors), (other_out, other_errors) = (process.communicate(timeout=240) for process in processes)
    assert [process.returncode for process in processes] == [0, 0], errors + other_errors
    assert (tmp_path / "run" / "run.cgs").is_file() and (tmp_path / "run" / "results.json").is_file()
    assert "trained in" in out and "PSNR" in out
    assert other_out == ""


def test_each_process_of_a_machine_has_its_own_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    cuda, cpu = torch.device("cuda"), torch.device("cpu")
    assert distributed.local_device(cuda) == cuda
    for name, value in {"WORLD_SIZE": "4", "RANK": "3", "LOCAL_RANK": "1"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert distributed.local_device(cuda) == torch.device("cuda", 1)
    assert distributed.local_device(torch.device("cuda", 0)) == torch.device("cuda", 0), "asked for"
    assert distributed.local_device(cpu) == cpu


def test_processes_that_do_not_meet_are_told_where_they_looked(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {
        "WORLD_SIZE": "2",
        "RANK": "1",
        "MASTER_ADDR": "10.0.0.1",
        "MASTER_PORT": "29500",
    }.items():
        monkeypatch.setenv(name, value)

    def nobody(backend: str) -> None:
        assert backend == "gloo"
        raise RuntimeError("timed out\nand more")

    monkeypatch.setattr(torch.distributed, "init_process_group", nobody)
    with (
        pytest.raises(ConfigError, match=r"^rank 1 of 2: .* at 10\.0\.0\.1:29500 \(timed out\)$"),
        distributed.joined(torch.device("cpu")),
    ):
        pass


def test_other_ranks_than_the_first_say_nothing_but_what_goes_wrong_with_them(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(distributed, "joined", lambda device: contextlib.nullcontext())
    for rank, said, prefix in (("0", "heard\n", ""), ("1", "", "rank 1: ")):
        monkeypatch.setenv("RANK", rank)
        monkeypatch.setenv("WORLD_SIZE", "2")
        with pytest.raises(TrainingError, match=f"^{prefix}it broke$"), among_ranks("cpu") as leads:
            assert leads == (rank == "0")
            say("heard")
            raise TrainingError("it broke")
        assert capsys.readouterr().out == said
