"""Commands on models that lie far from the world's origin."""

from pathlib import Path

import numpy as np
import pytest
import torch

import compgs.codec
from compgs.cli.decode import Decode
from compgs.cli.render import Render
from compgs.config import Config, ModelConfig
from compgs.formats import read_ply
from compgs.methods import write
from compgs.model.splats import SplatArrays, SplatModel
from compgs.trained_model import TrainedModel


def test_the_circle_is_given_in_the_world_and_looks_at_the_model() -> None:
    command = Render(file=Path("a.cgs"), output=Path("out"), frames=4)
    config = Config(model=ModelConfig(coupled_primitives=4, reference_dim=8, residuals=True, width=16))
    coordinates = torch.arange(15).view(5, 3)
    offset = (4.2e6, -5.1e5, 3e3)
    near, far = (
        command.circle(TrainedModel(config, coordinates, 0.05, 3.0, (0.0, 0.0, 0.0), at).as_hybrid_model())
        for at in ((0.0, 0.0, 0.0), offset)
    )
    assert [name for name, _ in far] == [name for name, _ in near]
    for (_, a), (_, b) in zip(near, far, strict=True):
        np.testing.assert_allclose(b.center - offset, a.center, rtol=0, atol=1e-7)
        np.testing.assert_array_equal(a.rotation, b.rotation)


def test_decoded_arrays_say_where_they_count_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = Path(__file__).parents[1] / "golden" / "default.cgs"
    offset = (4.2e6, -5.1e5, 3e3)
    config = Config(model=ModelConfig(coupled_primitives=4, reference_dim=8, residuals=True, width=16))
    coordinates = torch.arange(15).view(5, 3)
    model = TrainedModel(config, coordinates, 0.05, 3.0, (0.0, 0.0, 0.0), offset).as_hybrid_model()
    monkeypatch.setattr(compgs.codec, "decode", lambda path, device=None, prefix=None: model)
    Decode(file=file, output=tmp_path / "arrays").run()
    for name, positions in (("latents.npz", "positions"), ("geometry.npz", "means")):
        with np.load(tmp_path / "arrays" / name) as arrays:
            assert arrays["world_offset"].tolist() == list(offset)
            assert arrays["world_offset"].dtype == np.float64
            assert np.abs(arrays[positions]).max() < 1e5


def test_the_splats_file_of_a_run_is_in_world_coordinates(tmp_path: Path) -> None:
    means = np.array([[1.0, 2.0, 3.0], [0.0, 0.5, -0.25]], np.float32)
    quaternions = np.array([[1.0, 0, 0, 0]] * 2, np.float32)
    others = (np.zeros(shape, np.float32) for shape in ((2,), (2, 3), (2, 0, 3)))
    splats = SplatArrays(means, np.zeros((2, 3), np.float32), quaternions, *others, (1000.0, -64.0, 0.5))
    write(SplatModel(splats, (0.0, 0.0, 0.0)), tmp_path / "a.ply", method="3dgs")
    assert read_ply(tmp_path / "a.ply").means.tolist() == [[1001.0, -62.0, 3.5], [1000.0, -63.5, 0.25]]
