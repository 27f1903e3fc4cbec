from dataclasses import replace

import numpy as np
import pytest
import torch

from compgs.codec import decode, encode
from compgs.codec.content import cross_entropy_bits
from compgs.codec.encoder import to_content
from compgs.codec.reader import file_info, read_content
from compgs.config import Config, EntropyConfig, ModelConfig
from compgs.errors import CorruptSection, NotEncodable, OutputError
from compgs.trained_model import TrainedModel

OWN_RESIDUALS = Config(model=ModelConfig(residuals=True))


def made_model(anchors: int = 400, seed: int = 0, config: Config | None = None) -> TrainedModel:
    """Plausible latents without a training: hyperpriors and references that mean something."""
    rng = np.random.default_rng(seed)
    coordinates = np.unique(rng.integers(-60, 60, (anchors, 3)), axis=0).astype(np.int32)
    torch.manual_seed(seed)
    model = TrainedModel(config or OWN_RESIDUALS, torch.from_numpy(coordinates), 0.02, 5.0, (0.0, 0.0, 0.0))
    with torch.no_grad():
        model.references.normal_(0, 1.5)
        model.residuals.add_(torch.randn_like(model.residuals))
        model.log_scales.normal_(0, 0.5)
        model.entropy.fit_covariance_prior(model.log_scales)
        model.mask[torch.rand(model.mask.shape) < 0.2] = False
    return model


def by_position(primitives) -> dict[tuple[int, ...], int]:
    voxels = torch.round(primitives.positions / primitives.voxel_size).to(torch.int64).tolist()
    return {tuple(v): i for i, v in enumerate(voxels)}


@pytest.mark.parametrize("hidden", [0, 16])
def test_the_decoded_scene_is_the_one_that_training_rendered(tmp_path, hidden):
    model = made_model(config=Config(entropy=EntropyConfig(network_hidden=hidden)))
    encode(model, tmp_path / "a.cgs")
    trained, decoded = model.as_hybrid_model(), decode(tmp_path / "a.cgs")
    assert decoded.coupled == trained.coupled == int(model.mask.sum())
    rows = by_position(trained.primitives)
    order = torch.tensor([rows[v] for v in by_position(decoded.primitives)])
    for name in ("references", "log_scales"):
        mine = getattr(trained.primitives, name)[order]
        # Hidden layers round in between: a latent in a thousand may fall to the neighbouring step.
        differs = (mine - getattr(decoded.primitives, name)).abs() > 1e-3
        assert differs.float().mean() < (2e-3 if hidden else 1e-4)
    for (_, a), (_, b) in zip(
        trained.heads.named_parameters(), decoded.heads.named_parameters(), strict=True
    ):
        assert torch.equal(a, b)


def test_bits_match_the_files_sections_within_one_percent():
    """Streams above 10 kB."""
    from compgs.codec.writer import write_content

    model = made_model(4000)
    with torch.no_grad():
        for analysis in (model.entropy.reference_analysis, model.entropy.residual_analysis):
            analysis.second.weight.mul_(8)  # hyperpriors that are worth coding
        # As after training, the scales fit the latents; symbols far out in the tails are capped by the tables.
        for network in (model.entropy.reference_network, model.entropy.residual_network):
            network.weights[-1][network.channels :].zero_()
            network.biases[-1][network.channels :] = 1.0
    content = to_content(model)
    sections = {s.name: 8 * s.bytes for s in file_info(write_content(content)).sections}
    estimated = model.estimated_bits()
    tables = cross_entropy_bits(content)
    compared = 0
    for stream, section in (
        ("reference_hyper", "reference hyperprior"),
        ("residual_hyper", "residual hyperprior"),
        ("reference", "reference embeddings"),
        ("covariance", "covariance"),
        ("residual", "residual embeddings"),
    ):
        if sections[section] > 80_000:
            assert sections[section] == pytest.approx(estimated[stream], rel=0.01)
            compared += 1
        assert sections[section] == pytest.approx(tables[stream], rel=0.002, abs=400)
    assert compared >= 4


def test_anchors_without_primitives_are_left_out(tmp_path):
    model = made_model()
    model.mask[::2] = False
    written = encode(model, tmp_path / "a.cgs")
    assert written.anchors == int(model.mask.any(1).sum()) < model.anchors


def test_encoding_twice_gives_the_same_bytes_and_leaves_the_model_as_it_was(tmp_path):
    model = made_model()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    encode(model, tmp_path / "a.cgs")
    encode(model, tmp_path / "b.cgs")
    assert (tmp_path / "a.cgs").read_bytes() == (tmp_path / "b.cgs").read_bytes()
    for name, value in model.state_dict().items():
        assert torch.equal(value, before[name]) and value.dtype == before[name].dtype, name


def test_an_existing_file_is_refused_unless_asked(tmp_path):
    path = tmp_path / "a.cgs"
    path.write_bytes(b"precious")
    with pytest.raises(OutputError, match="exists already"):
        encode(made_model(), path)
    assert path.read_bytes() == b"precious"
    encode(made_model(), path, overwrite=True)
    assert file_info(path.read_bytes()).anchors > 0


def test_what_cannot_be_represented_is_refused_before_anything_is_written(tmp_path):
    diverged = made_model()
    with torch.no_grad():
        diverged.references[3, 2] = torch.nan
    nothing = made_model()
    nothing.mask[:] = False
    twice = made_model()
    twice.coordinates[1] = twice.coordinates[0]
    for model in (diverged, nothing, twice):
        with pytest.raises(NotEncodable):
            encode(model, tmp_path / "a.cgs")
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_file_is_named_when_it_is_decoded(tmp_path):
    path = tmp_path / "damaged.cgs"
    encode(made_model(), path)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(bytes(data))
    with pytest.raises(CorruptSection, match=r"damaged\.cgs"):
        decode(path)


def test_heads_of_another_layout_are_refused(tmp_path):
    from compgs.codec.writer import write_content

    content = to_content(made_model())
    renamed = tuple((f"x{name}", tensor) for name, tensor in content.heads)
    path = tmp_path / "a.cgs"
    path.write_bytes(write_content(replace(content, heads=renamed)))
    with pytest.raises(CorruptSection, match="heads"):
        decode(path)


@pytest.mark.parametrize("threads", [1, 2])
def test_symbols_do_not_depend_on_the_number_of_threads(threads):
    import numba

    from compgs.codec.writer import write_content

    limit = numba.config.NUMBA_NUM_THREADS
    if threads > limit:
        pytest.skip(f"NUMBA_NUM_THREADS is {limit}: numba has no {threads} threads here")
    data = write_content(to_content(made_model(900)))
    numba.set_num_threads(threads)
    torch.set_num_threads(threads)
    try:
        content = read_content(data)
        assert write_content(content) == data
    finally:
        numba.set_num_threads(limit)
        torch.set_num_threads(2)


def test_shared_residuals_are_in_the_file_though_no_symbol_is(tmp_path):
    """All anchors have the one row, rounded as the entropy network's constants are."""
    model = made_model(500, config=Config())
    assert len(model.residuals) == 1
    with torch.no_grad():
        model.residuals.normal_(0, 2, generator=torch.Generator().manual_seed(1))
        model.mask[:] = True
    model.share_residuals()
    encode(model, tmp_path / "a.cgs")
    decoded = decode(tmp_path / "a.cgs").primitives.residuals
    row = (model.residuals * model.config.entropy.residual_step).detach().view(5, 8)
    torch.testing.assert_close(decoded.view(-1, 5, 8), row.expand(model.anchors, -1, -1), atol=1e-3, rtol=0)
    sizes = {s.name: s.bytes for s in file_info((tmp_path / "a.cgs").read_bytes()).sections}
    assert sizes["residual embeddings"] + sizes["residual hyperprior"] < 100
