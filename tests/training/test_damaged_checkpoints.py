"""A damaged checkpoint, well stamped or not, is a CheckpointError; what is taken is what was written."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors
import safetensors.torch
import torch

from compgs.config import Phases
from compgs.errors import CheckpointError
from compgs.training.run.model_checkpoint import load_checkpoint
from compgs.training.run.restoring import finite, restoring
from compgs.training.splats.trainer import SplatTrainer
from compgs.training.trainer import Trainer

CPU = torch.device("cpu")
KINDS = {"compgs": Trainer, "3dgs": SplatTrainer}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, blob_scene) -> dict[str, tuple[Path, Any]]:
    """A checkpoint of each kind after a few steps, with exposures and a mean of them, and its settings."""
    from compgs.config import Config, ModelConfig, TrainingConfig

    folder = tmp_path_factory.mktemp("checkpoints")
    config = Config(
        model=ModelConfig(coupled_primitives=4, reference_dim=8, residuals=True, width=16, voxel_size=0.1),
        training=TrainingConfig(steps=40, seed=3, exposure=True, phases=Phases(mean=0.0)),
    )
    result = {}
    for name, kind in KINDS.items():
        trainer = kind(blob_scene, config, CPU)
        for _ in range(9):
            trainer.train_step()
        trainer.save(folder / name)
        result[name] = folder / name, config
    return result


def contents(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    with safetensors.safe_open(path, framework="pt") as file:
        return {name: file.get_tensor(name) for name in file.keys()}, dict(file.metadata())  # noqa: SIM118


def resumed(kind: str, scene: Any, path: Path, config: Any) -> Any:
    return KINDS[kind].resumed(scene, path, config, CPU)


def rewrite(
    source: Path, path: Path, change: Callable[[dict[str, torch.Tensor], dict[str, Any]], None]
) -> Path:
    """A copy of a checkpoint with other content, stamped as well."""
    tensors, metadata = contents(source)
    texts = {name: json.loads(text) for name, text in metadata.items() if text.startswith(("{", "["))}
    change(tensors, texts)
    metadata |= {name: json.dumps(value) for name, value in texts.items()}
    safetensors.torch.save_file({k: v.contiguous() for k, v in tensors.items()}, path, metadata=metadata)
    return path


def with_nan(value: torch.Tensor) -> torch.Tensor:
    value = value.clone()
    value.view(-1)[-1] = float("nan")
    return value


DAMAGES: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
    "shorter": lambda value: value[:-1],
    "one more dimension": lambda value: value[None],
    "another type": lambda value: value.to(torch.float64 if value.dtype != torch.float64 else torch.int8),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "damage",
    [
        damage if damage in ("shorter", "missing") else pytest.param(damage, marks=pytest.mark.slow)
        for damage in (*DAMAGES, "not finite", "missing")
    ],
)
def test_each_tensor_is_checked(kind: str, damage: str, written, blob_scene, tmp_path: Path) -> None:
    source, config = written[kind]
    tensors, _ = contents(source)
    names = [name for name, value in tensors.items() if value.dim() or damage != "shorter"]
    if damage == "not finite":
        names = [name for name, value in tensors.items() if value.is_floating_point()]
    # One of each sort, as all of a sort are treated alike.
    chosen = {name.rsplit("/", 1)[0].rsplit(".", 1)[0] + name.rsplit("/", 1)[-1][:4]: name for name in names}
    for name in chosen.values():

        def change(tensors: dict[str, torch.Tensor], _: dict[str, Any], name: str = name) -> None:
            if damage == "missing":
                del tensors[name]
            else:
                tensors[name] = (with_nan if damage == "not finite" else DAMAGES[damage])(tensors[name])

        path = rewrite(source, tmp_path / "damaged", change)
        with pytest.raises(CheckpointError, match="damaged"):
            resumed(kind, blob_scene, path, config)


STATES = [
    ("step", -1), ("step", 41), ("step", "7"), ("step", None), ("step", True), ("order", [99]), ("order", [1, 1]),
    ("order", 7), ("order", None), ("shuffle", {}), ("shuffle", "x"), ("views", 3), ("views", None),
]  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("key", "value"), STATES, ids=str)
def test_the_state_is_checked(
    kind: str, key: str, value: object, written, blob_scene, tmp_path: Path
) -> None:
    source, config = written[kind]
    path = rewrite(source, tmp_path / "damaged", lambda _, texts: texts["state"].update({key: value}))
    with pytest.raises(CheckpointError):
        resumed(kind, blob_scene, path, config)
    path = rewrite(source, tmp_path / "damaged", lambda _, texts: texts["state"].pop(key))
    with pytest.raises(CheckpointError):
        resumed(kind, blob_scene, path, config)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("voxel_size", 0.0), ("voxel_size", float("nan")), ("voxel_size", "1"), ("distance_unit", -1.0),
        ("background", [0, 0]), ("background", None), ("world_offset", [0, 0, float("inf")]), ("up", []),
        ("viewpoints", [{}]), ("viewpoints", 7), ("viewpoints", [{"fx": 1}]),
        ("head_bits", 0), ("head_bits", 17), ("head_bits", "7"), ("head_bits", True),
    ],
    ids=str,
)  # fmt: skip
def test_what_a_checkpoint_says_of_the_scene_is_checked(
    key: str, value: object, written, blob_scene, tmp_path: Path
) -> None:
    source, config = written["compgs"]
    path = rewrite(source, tmp_path / "damaged", lambda _, texts: texts["scene"].update({key: value}))
    with pytest.raises(CheckpointError, match="damaged"):
        resumed("compgs", blob_scene, path, config)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("width", 0), ("width", 24), ("width", 1e3), ("width", None), ("heads", "both"), ("heads", 1),
        ("reference_context", 1), ("reference_context", "all"), ("residuals", "no"), ("residuals", False),
        ("coupled_primitives", 3), ("dropout", 0.9), ("rate_every", 0), ("start", {"anchors": 3}), ("reasons", 1),
    ],
    ids=str,
)  # fmt: skip
def test_what_a_checkpoint_says_of_the_plan_is_checked(
    key: str, value: object, written, blob_scene, tmp_path: Path
) -> None:
    source, config = written["compgs"]
    path = rewrite(source, tmp_path / "damaged", lambda _, texts: texts["plan"].update({key: value}))
    with pytest.raises(CheckpointError, match="damaged"):
        resumed("compgs", blob_scene, path, config)


@pytest.mark.parametrize("kind", KINDS)
def test_a_run_goes_on_on_the_kind_of_device_that_it_began_on(
    kind: str, written, blob_scene, tmp_path: Path
) -> None:
    source, config = written[kind]
    tensors, metadata = contents(source)
    assert metadata["device"] == "cpu"
    path = tmp_path / "moved"
    safetensors.torch.save_file(tensors, path, metadata={**metadata, "device": "cuda"})
    with pytest.raises(CheckpointError, match=r"began on cuda.*--device cuda"):
        resumed(kind, blob_scene, path, config)


def test_settings_out_of_range_are_the_checkpoints_fault(written, tmp_path: Path) -> None:
    source, _ = written["compgs"]
    for section, key, value in (("model", "width", 10**9), ("training", "steps", "x"), ("model", "odd", 1)):
        path = rewrite(
            source,
            tmp_path / "damaged",
            lambda _, texts, at=(section, key, value): texts["config"][at[0]].update({at[1]: at[2]}),
        )
        with pytest.raises(CheckpointError, match="damaged"):
            load_checkpoint(path)


def test_more_memory_than_the_file_has_is_not_taken(written, tmp_path: Path) -> None:
    """Coordinates alone promise a million anchors of 65 000 numbers each."""
    source, _ = written["compgs"]

    def change(tensors: dict[str, torch.Tensor], _: dict[str, Any]) -> None:
        tensors["model/coordinates"] = torch.zeros(1_000_000, 3, dtype=torch.int32)

    with pytest.raises(CheckpointError, match="damaged"):
        load_checkpoint(rewrite(source, tmp_path / "damaged", change))


@pytest.mark.parametrize("kind", KINDS)
def test_flipped_bytes_are_an_error_or_harmless(kind: str, written, blob_scene, tmp_path: Path) -> None:
    """In the header and in what follows it; never another exception."""
    source, config = written[kind]
    whole = source.read_bytes()
    header = int.from_bytes(whole[:8], "little") + 8
    rng = np.random.default_rng(0)
    places = [*rng.integers(0, header, 24).tolist(), *rng.integers(header, len(whole), 6).tolist()]
    path = tmp_path / "damaged"
    refused = 0
    for place in places:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            resumed(kind, blob_scene, path, config)
        except CheckpointError as error:
            assert str(path) in str(error) or "run to continue" in str(error)
            refused += 1
    assert refused > 12
    for length in (0, 7, header // 2, header, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(CheckpointError):
            resumed(kind, blob_scene, path, config)


def test_what_is_whole_goes_on(written, blob_scene) -> None:
    for kind, (path, config) in written.items():
        assert resumed(kind, blob_scene, path, config).step == 9
        with pytest.raises(CheckpointError, match="other settings"):
            resumed(kind, blob_scene, path, replace(config, training=replace(config.training, seed=4)))


@pytest.mark.parametrize(
    "values", [[1.0], [1.0, 2.0, 3.0], (1.0, 2.0), [1.0, float("nan")], [1.0, 0.5], [1.0, True], "12", None]
)
def test_numbers_are_as_many_as_expected_finite_and_above_the_least(values: object) -> None:
    assert finite([1.0, 2], 2, "units", above=0.5) == (1.0, 2.0)
    with pytest.raises(ValueError, match="units: expected 2 finite numbers"):
        finite(values, 2, "units", above=0.5)


def test_a_long_reason_is_cut(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError) as error, restoring(tmp_path / "checkpoint"):
        raise ValueError("=" * 1000)
    assert str(error.value).count("=") == 200
