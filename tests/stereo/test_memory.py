"""Memory of the plane sweep, counted: of tensors as torch makes them, of arrays as Python's tracemalloc sees them."""

import tracemalloc
import weakref
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from compgs.cameras import Camera
from compgs.scene.views import View
from compgs.stereo import plane_sweep
from compgs.stereo.fusion import Places, thinned
from compgs.stereo.looks import Look, looks_of

CPU = torch.device("cpu")
WIDTH, HEIGHT = 96, 64
PIXELS = WIDTH * HEIGHT


class Tensors(TorchDispatchMode):
    """Counts the bytes of tensors that are made within it, and of those that are gone again."""

    def __init__(self) -> None:
        super().__init__()
        self.live = self.peak = 0
        self._known: set[int] = set()

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = function(*args, **(kwargs or {}))
        for tensor in result if isinstance(result, tuple | list) else (result,):
            if isinstance(tensor, torch.Tensor):
                self._count(tensor.untyped_storage())
        return result

    def _count(self, storage: torch.UntypedStorage) -> None:
        address, size = storage.data_ptr(), storage.nbytes()
        if address in self._known:
            return
        self._known.add(address)
        self.live += size
        self.peak = max(self.peak, self.live)
        weakref.finalize(storage, self._gone, address, size)

    def _gone(self, address: int, size: int) -> None:
        self._known.discard(address)
        self.live -= size


def camera(x: float) -> Camera:
    pose = np.eye(4)
    pose[0, 3] = -x
    return Camera(pose, 80.0, 80.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)


def views(count: int) -> list[View]:
    chance = np.random.default_rng(0)
    return [
        View(f"{i}.png", camera(0.1 * i), chance.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8))
        for i in range(count)
    ]


def look(x: float) -> Look:
    gray = torch.from_numpy(np.random.default_rng(0).random((HEIGHT, WIDTH), np.float32))
    return Look(camera(x), np.zeros((HEIGHT, WIDTH, 3), np.uint8), gray, None)


def swept_bytes(neighbours: int) -> float:
    """Bytes a pixel of the tensors that a sweep has at once."""
    others = [look(0.3 * (1 + i)) for i in range(neighbours)]
    with Tensors() as tensors:
        plane_sweep.swept(look(0.0), others, 2.0, 8.0)
    return tensors.peak / PIXELS


def test_a_sweep_has_the_arrays_of_few_planes_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    likeness = 4 * plane_sweep.PLANES  # bytes a pixel, of one array of all planes
    # That array, its parts, and a dozen arrays of a few planes each.
    assert likeness < swept_bytes(4) < 4.5 * likeness
    # A neighbour adds its picture, and one array of the planes at hand.
    assert swept_bytes(8) - swept_bytes(4) <= 4 * (4 + 4 * plane_sweep.AT_ONCE)
    # All planes at once would take several times as much: the measure sees it.
    monkeypatch.setattr(plane_sweep, "AT_ONCE", plane_sweep.PLANES)
    assert swept_bytes(4) > 10 * likeness


def test_planes_at_once_change_no_bit_of_a_sweep(monkeypatch: pytest.MonkeyPatch) -> None:
    sweep = look(0.0), [look(0.3), look(0.6), look(0.9)], 2.0, 8.0
    few, _ = plane_sweep.swept(*sweep)
    monkeypatch.setattr(plane_sweep, "AT_ONCE", plane_sweep.PLANES)
    assert torch.equal(few, plane_sweep.swept(*sweep)[0])


def test_a_further_photograph_adds_a_gray_and_a_colored_picture() -> None:
    def kept(count: int) -> tuple[int, int]:
        """Bytes of tensors, which numpy's arrays of them share, while the looks are there; and the most meanwhile."""
        photographs = views(count)
        with Tensors() as tensors:
            looks = looks_of(photographs, CPU)
            live, peak = tensors.live, tensors.peak
        assert len(looks) == count
        return live, peak

    (few, few_peak), (many, many_peak) = kept(6), kept(24)
    each = (4 + 3) * PIXELS
    assert many - few == 18 * each
    assert many_peak - few_peak == 18 * each


def test_thinning_takes_at_most_a_hundred_bytes_a_place() -> None:
    chance = np.random.default_rng(0)
    count = 200_000
    places = Places(
        chance.uniform(-3, 3, (count, 3)),
        chance.integers(0, 256, (count, 3), dtype=np.uint8),
        chance.uniform(0.05, 0.1, count),
    )
    tracemalloc.start()
    try:
        found = thinned(places, 4.0, np.full((1, 3), 100.0))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(found) > 1_000
    assert peak / count < 100
