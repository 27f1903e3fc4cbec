from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from compgs.codec import content as content_module
from compgs.codec import decode, encode
from compgs.codec.content import Role, cross_entropy_bits
from compgs.codec.encoder import encoded, integer_network, to_content
from compgs.codec.integer_network import IntegerNetwork, entropy_parameters, evaluate
from compgs.codec.reader import file_info, group_names, read_content, read_latents
from compgs.codec.viewpoint_cameras import kept_viewpoints
from compgs.codec.writer import write_content
from compgs.config import Config, EntropyConfig, ModelConfig
from compgs.entropy.contexts import Hyperprior
from compgs.entropy.network import EntropyNetwork
from compgs.entropy.quantization import weight_exponent
from compgs.errors import ConfigError, CorruptSection, NotEncodable, OutputError, TruncatedSection
from compgs.evaluation.camera_path import orbit
from compgs.model.constants import SHARED_RESIDUALS
from compgs.stored_weights import SHARED_RESIDUAL_BITS
from compgs.trained_model import TrainedModel
from compgs.training.structure.decorrelation import keep_channels

OWN_RESIDUALS = Config(model=ModelConfig(residuals=True, reference_context="hyperprior"))


SHARED = Config(model=ModelConfig(reference_context="hyperprior"))


def config_of(blocks: int, residuals: bool = True, width: int = 16, context: Any = None) -> Config:
    """The paper's kind of entropy model with blocks; without them that of small files, where references have no
    context, or another one.
    """
    context = context or ("hyperprior" if blocks else "none")
    return Config(
        model=ModelConfig(residuals=residuals, reference_context=context, width=width),
        entropy=EntropyConfig(network_blocks=blocks),
    )


DILATION = 2.0**-20


def made_model(
    anchors: int = 400, seed: int = 0, config: Config | None = None, dilation: float | None = DILATION
) -> TrainedModel:
    """Plausible latents without a training: hyperpriors and references that mean something."""
    rng = np.random.default_rng(seed)
    coordinates = np.unique(rng.integers(-60, 60, (anchors, 3)), axis=0).astype(np.int32)
    torch.manual_seed(seed)
    model = TrainedModel(config or OWN_RESIDUALS, torch.from_numpy(coordinates), 0.02, 5.0, (0.0, 0.0, 0.0))
    model.angular_dilation = dilation
    with torch.no_grad():
        model.references.normal_(0, 1.5)
        model.residuals.add_(torch.randn_like(model.residuals))
        model.log_scales.normal_(0, 0.5)
        model.entropy.fit_covariance_prior(model.log_scales)
        model.mask[torch.rand(model.mask.shape) < 0.2] = False
    return model


def by_position(primitives) -> dict[tuple[int, ...], int]:
    voxels = np.rint(primitives.positions / primitives.voxel_size).astype(np.int64).tolist()
    return {tuple(v): i for i, v in enumerate(voxels)}


@pytest.mark.parametrize(("blocks", "context"), [(0, "none"), (0, "neighbours"), (2, "hyperprior")])
@pytest.mark.parametrize("residuals", [True, False])
def test_the_decoded_scene_is_the_one_that_training_rendered(tmp_path, blocks, context, residuals):
    model = made_model(1500, config=config_of(blocks, residuals, context=context))
    with torch.no_grad():
        for network in model.entropy.reference_networks:
            for parameter in network.per_channel:
                parameter.uniform_(-0.3, 0.9)
        model.entropy.log_covariance_step.add_(torch.linspace(-0.5, 0.5, 6))  # six steps
    encode(model, tmp_path / "a.cgs")
    trained, decoded = model.as_hybrid_model(), decode(tmp_path / "a.cgs")
    assert decoded.coupled == trained.coupled == int(model.mask.sum())
    rows = by_position(trained.primitives)
    order = np.array([rows[v] for v in by_position(decoded.primitives)])
    for name in ("references", "log_scales"):
        mine = getattr(trained.primitives, name)[order]
        # Hidden layers round in between: a latent in a thousand may fall to the neighbouring step.
        differs = np.abs(mine - getattr(decoded.primitives, name)) > 1e-3
        assert differs.mean() < (5e-3 if blocks else 1e-4)
    assert trained.heads.tensors.keys() == decoded.heads.tensors.keys()
    for name, tensor in trained.heads.tensors.items():
        assert np.array_equal(tensor, decoded.heads.tensors[name])
    # Primitives of an anchor keep their order, so that of these, too, each has its own.
    own = [trained.primitives.anchor_index == rows[v] for v in by_position(decoded.primitives)]
    mine = np.concatenate([trained.primitives.residuals[chosen] for chosen in own])
    differs = np.abs(mine - decoded.primitives.residuals) > 1e-3
    assert differs.mean() < (5e-3 if blocks else 1e-4)
    counts = [int(chosen.sum()) for chosen in own]
    assert np.array_equal(np.repeat(np.arange(len(own)), counts), decoded.primitives.anchor_index)


@pytest.mark.parametrize("blocks", [0, 2])
def test_bits_match_the_files_sections_within_one_percent(blocks):
    """Streams above 10 kB, whose rows say nothing: training pays for each symbol by itself."""
    model = made_model(7000, config=config_of(blocks), dilation=None)
    with torch.no_grad():
        for hyperprior in (model.entropy.reference_context, model.entropy.residual_hyperprior):
            if isinstance(hyperprior, Hyperprior):
                hyperprior.analysis.second.weight.mul_(8)  # worth coding
        # As after training, the scales fit the latents; symbols far out in the tails are capped by the tables.
        for network in (model.entropy.reference_network, model.entropy.residual_network):
            network.weights[-1][network.channels :].zero_()
            network.biases[-1][network.channels :] = 1.0
    content = to_content(model)
    info = file_info(write_content(content))
    sections = {s.name: 8 * s.bytes for s in info.sections}
    estimated = model.estimated_bits()
    tables = dict(zip(group_names(content.dimensions), cross_entropy_bits(content), strict=True))
    compared = 0
    for stream, section in (
        ("reference_hyper", "reference hyperprior"),
        ("residual_hyper", "residual hyperprior"),
        ("reference", "reference embeddings"),
        ("covariance", "log scales"),
        ("residual", "residual embeddings"),
    ):
        if stream not in estimated:
            assert stream == "reference_hyper" and section not in sections
            continue
        if sections[section] > 80_000:
            assert sections[section] == pytest.approx(estimated[stream], rel=0.01)
            compared += 1
        state_and_sizes = 96 * len(info.ranges)
        assert sections[section] == pytest.approx(tables[section], rel=0.002, abs=state_and_sizes)
    assert compared >= 3 + (blocks > 0)


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
    content = to_content(made_model(dilation=None))  # later versions have no names
    renamed = tuple((f"x{name}", tensor) for name, tensor in content.heads)
    path = tmp_path / "a.cgs"
    path.write_bytes(write_content(replace(content, heads=renamed)))
    with pytest.raises(CorruptSection, match="heads"):
        decode(path)


@pytest.mark.parametrize("threads", [1, 2])
def test_symbols_do_not_depend_on_the_number_of_threads(threads, with_threads):
    with_threads(3 - threads)
    data = write_content(to_content(made_model(900)))
    with_threads(threads)
    content = read_content(data)
    assert write_content(content) == data


def test_shared_residuals_are_in_the_file_though_no_symbol_is(tmp_path):
    """All anchors have the same K, as a tensor beside the heads' weights, and as training saw it."""
    model = made_model(500, config=SHARED)
    assert len(model.residuals) == 1
    with torch.no_grad():
        model.residuals.normal_(0, 2, generator=torch.Generator().manual_seed(1))
        model.mask[:] = True
    encode(model, tmp_path / "a.cgs")
    decoded = decode(tmp_path / "a.cgs").primitives.residuals
    row = model.shared_residuals().detach()
    step = 2.0 ** -weight_exponent(row, SHARED_RESIDUAL_BITS)
    assert step < 0.05 < float(row.abs().max())
    assert np.abs(decoded.reshape(-1, 5, 8) - row.numpy()).max() <= step / 2
    assert np.array_equal(decoded, model.as_hybrid_model().primitives.residuals)
    info = file_info((tmp_path / "a.cgs").read_bytes())
    assert not [s.name for s in info.sections if s.name.startswith("residual")]
    assert [g.role for g in info.dimensions.groups] == [Role.SIDE, Role.REFERENCE, Role.LOG_SCALES]


def test_without_a_hyperprior_each_channel_of_the_references_has_one_mean_and_one_scale():
    """A network on the anchors' coordinates, of zeros, which take no byte each."""
    config = Config(model=ModelConfig(reference_context="none"))
    content = to_content(made_model(2000, config=config))
    references, log_scales = content.groups
    assert (references.shape.role, references.shape.context) == (Role.REFERENCE, ())
    assert references.shape.sees_coordinates and not log_scales.shape.sees_coordinates
    assert log_scales.shape.context == (0,)
    (layer,) = references.prior.layers
    assert layer.weight.shape == (64, 3) and not layer.weight.any()
    sizes = {s.name: s.bytes for s in file_info(write_content(content)).sections}
    one_channel = Config(
        model=ModelConfig(reference_context="hyperprior"), entropy=EntropyConfig(reference_hyper_dim=1)
    )
    other = to_content(made_model(2000, config=one_channel))
    with_one = {s.name: s.bytes for s in file_info(write_content(other)).sections}
    assert sizes["entropy networks"] < with_one["entropy networks"] - 40
    assert "reference hyperprior" not in sizes and sizes["tables"] == 0


def test_own_residuals_leave_no_tensor_of_shared_ones():
    names = [name for name, _ in to_content(made_model(50)).heads]
    assert SHARED_RESIDUALS not in names
    assert SHARED_RESIDUALS in [name for name, _ in to_content(made_model(50, config=Config())).heads]


def test_shared_residuals_of_another_shape_are_refused(tmp_path):
    content = to_content(made_model(50, config=Config(), dilation=None))
    path = tmp_path / "a.cgs"
    for shape in ((8, 5), (40,)):
        heads = tuple(
            (name, replace(t, values=t.values.reshape(shape)) if name == SHARED_RESIDUALS else t)
            for name, t in content.heads
        )
        path.write_bytes(write_content(replace(content, heads=heads)))
        with pytest.raises(CorruptSection, match=r"a\.cgs: prediction heads: residuals has shape"):
            decode(path)
    path.write_bytes(write_content(replace(content, heads=content.heads[:-1])))
    with pytest.raises(CorruptSection, match=r"prediction heads: expected .*residuals"):
        decode(path)


@pytest.mark.parametrize("config", [OWN_RESIDUALS, Config()])
def test_a_beginning_of_a_file_is_the_coarse_part_of_its_scene(tmp_path, config):
    path = tmp_path / "a.cgs"
    encode(made_model(1200, config=config), path)
    whole = decode(path).primitives
    size = path.stat().st_size
    ranges = file_info(path.read_bytes()).ranges
    assert len(ranges) > 1 and ranges[-1].anchors == len(whole.positions)
    for part in ranges:
        for count in (part.bytes, part.bytes + 7):
            coarse = decode(path, prefix=count).primitives
            assert len(coarse.positions) == part.anchors
            for name in ("positions", "references"):
                assert np.array_equal(getattr(coarse, name), getattr(whole, name)[: part.anchors]), name
            assert np.array_equal(coarse.log_scales[:, :3], whole.log_scales[: part.anchors, :3])
            # What stands for many is larger: by the cube root of their number, all volumes together stay.
            growth = (coarse.log_scales - whole.log_scales[: part.anchors])[:, 3:]
            many = np.exp(3 * growth.astype(np.float64))
            assert (many > 1 - 1e-4).all()
            np.testing.assert_allclose(many.sum(0), np.full(3, len(whole.positions)), rtol=1e-4)
            coupled = len(coarse.residuals)
            assert np.array_equal(coarse.residuals, whole.residuals[:coupled])
            assert np.array_equal(coarse.anchor_index, whole.anchor_index[:coupled])
            assert (whole.anchor_index[coupled:] >= part.anchors).all()
    assert np.array_equal(decode(path, prefix=10 * size).primitives.positions, whole.positions)
    with pytest.raises(TruncatedSection, match=r"a\.cgs: latents: of \d+ bytes nothing can be shown yet"):
        decode(path, prefix=ranges[0].bytes - 1)
    with pytest.raises(TruncatedSection, match=r"a\.cgs: header: the file ends after 0 bytes$"):
        decode(path, prefix=0)
    with pytest.raises(ConfigError, match="prefix = -5: expected a number of bytes"):
        decode(path, prefix=-5)


@pytest.mark.parametrize(("blocks", "bits"), [(0, 10), (1, 10), (2, 8), (2, 14)])
def test_the_network_that_is_trained_is_the_one_in_the_file(blocks, bits):
    """Float network with stored weights against the integers: a unit of the last place for the rounding of each layer,
    one for that of its slope, and what the layers after it make of these.
    """
    torch.manual_seed(blocks)
    network = EntropyNetwork(7, 5, blocks, 9, mean_gain=4.0).double()
    with torch.no_grad():
        for bias in network.biases:
            bias.normal_()
    stored = integer_network(network, bits)
    assert (stored.inputs, stored.outputs, len(stored.layers)) == (7, 10, 1 + 2 * blocks + (blocks > 0))
    x = torch.randint(-(1 << 14), 1 << 14, (300, 7))
    with torch.no_grad():
        mean, scale = network(x.double() / 4096, bits)
    found = evaluate(stored, x.numpy()) / 4096

    unit = 1 / 4096
    error, before = np.zeros(7), np.zeros(7)
    for i, layer in enumerate(stored.layers):
        taken = np.append(error, np.zeros(7)) if stored.skip and i == len(stored.layers) - 1 else error
        after = np.abs(layer.weight) @ taken * 2.0**-layer.shift + 2 * unit + (before if layer.adds else 0)
        before, error = error, after
    assert (np.abs(torch.cat([mean, scale], 1).numpy() - found).max(0) <= error).all()
    assert 20 * error.max() < np.abs(found).max()


def test_an_entropy_model_of_every_kind_is_written_as_the_paper_has_it():
    """Roles, contexts and shapes of networks: residual MLPs of so many blocks, references as context."""
    content = to_content(made_model(50, config=config_of(blocks=2, width=24)))
    assert not any(g.shape.sees_coordinates for g in content.groups)
    assert [(g.shape.role, g.shape.context) for g in content.groups] == [
        (Role.SIDE, ()),
        (Role.REFERENCE, (0,)),
        (Role.LOG_SCALES, (1,)),
        (Role.SIDE, ()),
        (Role.RESIDUAL, (1, 3)),
    ]
    assert content.groups[3].shape.channels == content.coupled_primitives
    assert len(content.groups[2].shape.steps) == 6
    for group in content.groups:
        if isinstance(group.prior, IntegerNetwork):
            assert [layer.adds for layer in group.prior.layers] == [False, False, True, False, True, False]
            assert [layer.rectify for layer in group.prior.layers] == [True, True, False, True, False, False]
            assert [len(layer.bias) for layer in group.prior.layers[:-1]] == [24] * 5
            assert group.prior.skip


@pytest.mark.parametrize("config", [OWN_RESIDUALS, SHARED])
def test_each_network_is_evaluated_once_for_each_block_of_rows(config, monkeypatch):
    """And once more where it got a chain, whose tables are others."""
    seen = []

    def counted(network, x, mask=None):
        seen.append((id(network), len(x)))
        return entropy_parameters(network, x, mask)

    monkeypatch.setattr(content_module, "entropy_parameters", counted)
    model = made_model(900, config=config)  # three ranges in the file
    content = encoded(model)[1]
    chains = sum(
        isinstance(g.prior, IntegerNetwork) and g.prior.rows.chain is not None for g in content.groups
    )
    assert len({network for network, _ in seen}) == len(seen) == len(model.entropy.coded_networks) + chains
    assert {rows for _, rows in seen} == {int(model.mask.any(1).sum())}


def test_groups_coded_by_the_encoder_are_those_of_a_walk_along_its_content(tmp_path):
    data, content = encoded(made_model(900))
    assert data == write_content(content)
    assert (content.coordinates == read_content(data).coordinates).all(), "in the file's order"


def test_encoding_leaves_the_model_as_it_is(tmp_path):
    model = made_model(100)
    config, before = model.config, {name: value.clone() for name, value in model.state_dict().items()}
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    views = tuple(camera for _, camera in orbit(corners, frames=3, width=8, height=8))
    model.viewpoints = views
    assert encoded(model, viewpoints=1)[1].viewpoints != encoded(model)[1].viewpoints
    assert encoded(model, viewpoints=0)[1].viewpoints is None
    after = model.state_dict()
    assert model.config is config and model.viewpoints == views and before.keys() == after.keys()
    assert all(
        torch.equal(before[name], after[name]) and before[name].dtype == after[name].dtype for name in after
    )


def test_a_model_that_lost_channels_has_its_own_dimensions(tmp_path):
    model = made_model(100)
    keep_channels(model, torch.arange(32) % 2 == 0)
    d = model.dimensions
    assert (d.reference_dim, d.coupled_primitives, model.config.model.reference_dim) == (16, 5, 32)
    assert model.entropy.channels["reference"] == 16
    assert encoded(model)[1].dimensions.reference_dim == 16


def test_rows_that_say_something_make_a_smaller_file_of_the_same_scene(tmp_path):
    """Log scales that go together, references that are large or small together; `model.row_context` turns it off."""
    models = []
    for row_context in (True, False):
        config = Config(model=ModelConfig(residuals=False, row_context=row_context))
        model = made_model(2000, config=config)
        with torch.no_grad():
            model.log_scales.add_(2 * torch.randn(model.anchors, 1))
            model.references.mul_(2.0 ** torch.randn(model.anchors, 1))
            model.entropy.fit_covariance_prior(model.log_scales)
        models.append(model)
    (data, content), (plain, plain_content) = map(encoded, models)
    assert len(data) < 0.9 * len(plain)
    assert content.group(Role.REFERENCE).prior.rows.inertia > 0
    assert content.group(Role.LOG_SCALES).prior.rows.chain is not None
    assert content.group(Role.REFERENCE).prior.rows.chain is None
    assert all(group.prior.rows.inertia == 0 for group in plain_content.groups)
    for ours, theirs in zip(read_latents(data)[1], read_latents(plain)[1], strict=True):
        assert np.array_equal(ours, theirs)


def test_small_files_keep_fewer_viewpoints_and_none_keeps_more_than_was_asked_for():
    assert [kept_viewpoints(12, anchors) for anchors in (1, 250, 500, 5000)] == [3, 3, 5, 12]
    assert kept_viewpoints(2, 10) == 2 and kept_viewpoints(0, 5000) == 0
