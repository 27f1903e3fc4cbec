"""What is cut off a trained tile: the anchors outside of its core, told in the world and in double precision."""

import math

import numpy as np
import pytest
import torch

from compgs.config import Config, ModelConfig
from compgs.errors import TrainingError
from compgs.formats.tiled import Core
from compgs.formats.tiled_ground import Ground
from compgs.tiles import Tile, cut_to_core
from compgs.trained_model import TrainedModel

ENDLESS = (-math.inf, math.inf)


def model_at(offset: tuple[float, float, float]) -> TrainedModel:
    """Anchors at 0.5, 1.0, 1.5, 2.0 along x of the local frame, one of them with a primitive less."""
    config = Config(model=ModelConfig(coupled_primitives=3, reference_dim=4, width=16))
    coordinates = torch.tensor([[1, 0, 0], [2, 3, 0], [3, 0, 9], [4, 0, 0]], dtype=torch.int32)
    model = TrainedModel(config, coordinates, 0.5, 3.0, (0.0, 0.0, 0.0), offset)
    model.mask[2, 1] = False
    return model


def tile(low: float, high: float) -> Tile:
    core = Core((low, ENDLESS[0]), (high, ENDLESS[1]))
    return Tile("0_0", core, core, 100, 1.0, ("a", "b"))


@pytest.mark.parametrize("x", [0.0, 4_000_000.25])
def test_coupled_primitives_stay_where_their_anchor_is_in_the_core(x: float) -> None:
    ground = Ground((x, 7.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    model = model_at((x, 0.0, 0.0))
    cut_to_core(model, ground, tile(1.0, 2.0))  # [1, 2): the first of its edges is its own, the second is not
    expected = np.array([[0, 0, 0], [1, 1, 1], [1, 0, 1], [0, 0, 0]], dtype=bool)
    np.testing.assert_array_equal(model.mask.numpy(), expected)


def test_a_tile_of_which_nothing_is_left_is_an_error() -> None:
    ground = Ground((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    with pytest.raises(TrainingError, match="tile 0_0: no anchor is left in its core"):
        cut_to_core(model_at((0.0, 0.0, 0.0)), ground, tile(5.0, 6.0))
