"""Which device is taken where none is asked for, and why it is not the GPU."""

from types import SimpleNamespace

import pytest

from compgs import devices
from compgs.errors import MissingDependency
from compgs.tensors import gsplat_backend


@pytest.mark.parametrize(
    ("missing", "gpus", "kernels", "name", "reason"),
    [
        ((), 0, True, "cpu", "no CUDA GPU"),
        (("torch", "gsplat"), 1, True, "cpu", "no CUDA GPU"),
        (("gsplat",), 1, True, "cpu", "gsplat is not installed"),
        ((), 1, False, "cpu", "nvcc"),
        ((), 1, True, "cuda", "gsplat is installed"),
    ],
)
def test_a_gpu_is_taken_only_where_everything_for_it_is_there(
    monkeypatch: pytest.MonkeyPatch,
    missing: tuple[str, ...],
    gpus: int,
    kernels: bool,
    name: str,
    reason: str,
) -> None:
    monkeypatch.setattr(devices, "missing", lambda extra: missing)
    monkeypatch.setattr(devices, "_gpus", lambda: gpus)
    monkeypatch.setattr(devices, "_kernels_can_be_had", lambda: kernels)
    choice = devices.choose(None)
    assert choice.name == name == devices.chosen_device(None)
    assert reason in choice.reason


def test_kernels_that_must_be_compiled_are_announced_and_without_nvcc_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(gsplat_backend, "load_gsplat", lambda: None)
    monkeypatch.setattr(gsplat_backend, "_built_before", lambda: False)
    monkeypatch.setattr(gsplat_backend.importlib.util, "find_spec", lambda name: None)
    backend = SimpleNamespace(_C=None)
    monkeypatch.setattr(gsplat_backend.importlib, "import_module", lambda name: backend)
    said: list[str] = []
    with pytest.raises(MissingDependency, match=r"nvcc.*--device cpu"):
        devices.prepare_device("cuda", said.append)
    assert len(said) == 1 and "minutes" in said[0]
    backend._C = object()
    devices.prepare_device("cuda", said.append)
