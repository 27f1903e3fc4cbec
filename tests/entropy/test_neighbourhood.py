"""What neighbours have in training against the decoder's integers, and against its definition in float64."""

import numpy as np
import pytest
import torch

from compgs.codec.content import surroundings
from compgs.codec.integer_network import IntegerLayer, IntegerNetwork
from compgs.config import EntropyConfig, ModelConfig
from compgs.entropy.models import make_entropy_model
from compgs.entropy.neighbourhood import neighbourhood
from compgs.ordering.order import canonical_order

CHANNELS = 5


@pytest.fixture(scope="module")
def coordinates() -> torch.Tensor:
    rng = np.random.default_rng(3)
    plane = np.column_stack([rng.integers(-90, 90, (3000, 2)), rng.integers(0, 3, 3000)])
    return torch.from_numpy(np.unique(plane, axis=0).astype(np.int32)[rng.permutation(1500)])


@pytest.fixture
def latents(coordinates: torch.Tensor) -> torch.Tensor:
    return torch.randn(len(coordinates), CHANNELS, generator=torch.Generator().manual_seed(0)) * 4


def test_training_sees_around_an_anchor_what_the_decoder_will(
    coordinates: torch.Tensor, latents: torch.Tensor
) -> None:
    """To a few units of the last place: integers round down, weights by integer division."""
    centre = torch.linspace(-2, 2, CHANNELS)
    bias = np.append(np.rint(centre.numpy() * 4096), np.zeros(CHANNELS)).astype(np.int64)
    network = IntegerNetwork((IntegerLayer(np.zeros((2 * CHANNELS, 2), np.int32), bias, 0, False),))
    order = canonical_order(coordinates.numpy())
    fixed = np.rint(latents.numpy()[order] * 4096).astype(np.int32)
    known = surroundings(coordinates.numpy()[order])
    assert len(known.ends) > 2
    decoded = np.concatenate(
        [known.around(i, network, fixed[: known.rows(i).start]) for i in range(len(known.ends))]
    )
    seen = neighbourhood(coordinates).around(latents, centre, None)
    np.testing.assert_allclose(seen.numpy()[order], decoded / 4096, atol=2e-3, rtol=1e-4)
    rows = torch.tensor([7, 3, 700])
    assert torch.equal(neighbourhood(coordinates).around(latents, centre, rows), seen[rows])


def test_other_devices_and_precisions_see_the_same(coordinates: torch.Tensor, latents: torch.Tensor) -> None:
    """What a GPU computes, here in float64."""
    found, centre, rows = neighbourhood(coordinates), torch.ones(CHANNELS), torch.arange(100, 900, 3)
    for some in (rows, None):
        general = found.around(latents.double(), centre.double(), some)
        torch.testing.assert_close(
            found.around(latents, centre, some).double(), general, rtol=1e-5, atol=1e-5
        )


def test_the_first_range_knows_of_nobody_and_every_other_anchor_of_somebody(
    coordinates: torch.Tensor, latents: torch.Tensor
) -> None:
    found = neighbourhood(coordinates)
    around = found.around(latents, torch.zeros(CHANNELS), None)
    order = canonical_order(coordinates.numpy())
    first, *ends = surroundings(coordinates.numpy()[order]).ends
    assert ends
    assert not around[order[:first]].any()
    assert (around[order[first:], :1] == 1).all() and (around[order[first:], 1] > 0).all()


def test_of_neighbours_that_all_have_the_same_that_is_what_is_seen(coordinates: torch.Tensor) -> None:
    same = torch.linspace(1, 2, CHANNELS).repeat(len(coordinates), 1)
    found = neighbourhood(coordinates)
    around = found.around(same, torch.zeros(CHANNELS), None)
    around = around[around[:, 0] == 1]
    assert len(around) > 500
    torch.testing.assert_close(around[:, 2:], same[: len(around)])
    torch.testing.assert_close(around[:, 1], torch.full((len(around),), 1.5))


def test_one_anchor_has_no_neighbours() -> None:
    found = neighbourhood(torch.tensor([[4, -7, 2]], dtype=torch.int32))
    assert not found.around(torch.ones(1, CHANNELS), torch.zeros(CHANNELS), None).any()


def test_references_like_their_neighbours_take_fewer_bits_once_means_follow(
    coordinates: torch.Tensor,
) -> None:
    """A smooth field with noise: by bits of Gaussians the noise's spread is left, where it was the field's."""
    torch.manual_seed(0)
    model = ModelConfig(coupled_primitives=2, reference_dim=4, residual_dim=2)
    entropy = make_entropy_model(model, EntropyConfig())
    places = coordinates.float() / 45
    field = 12 * torch.stack([places[:, 0].sin(), places[:, 1].cos(), places.sum(1).sin(), places[:, 0]], 1)
    f = field + torch.randn(field.shape, generator=torch.Generator().manual_seed(1))
    found = neighbourhood(coordinates)
    network = entropy.neighbour_network

    def bits() -> torch.Tensor:
        around = found.around(f, network.centre, None)
        coded = entropy(f, torch.zeros(len(f), 6), torch.zeros(1, 4), rate=True, around=around)
        assert coded.bits_in_file.keys() == {"reference", "covariance"}
        return coded.bits_in_file["reference"][around[:, 0] == 1].mean()

    entropy.restart_reference_scales(f, lambda: found.around(f, network.centre, None))
    with torch.no_grad():
        network.follow.zero_()
    alone = float(bits().detach())
    optimizer = torch.optim.Adam(network.parameters(), 0.03)
    for _ in range(300):
        optimizer.zero_grad()
        bits().backward()
        optimizer.step()
    assert float(bits().detach()) < alone - 4 * 1.5
    assert (network.follow > 0.6).all()


def test_latents_do_not_depend_on_neighbours_and_do_not_learn_from_them(coordinates: torch.Tensor) -> None:
    torch.manual_seed(0)
    model = ModelConfig(coupled_primitives=2, reference_dim=4, residual_dim=2)
    entropy = make_entropy_model(model, EntropyConfig())
    f = (torch.randn(len(coordinates), 4) * 3).requires_grad_()
    found, centre = neighbourhood(coordinates), entropy.neighbour_network.centre
    around = found.around(f, centre, None)
    nothing = torch.zeros_like(around)
    for noise in (None, lambda x: torch.zeros_like(x)):
        some, others = (
            entropy(f, torch.zeros(len(f), 6), torch.zeros(1, 4), rate=True, noise=noise, around=a)
            for a in (around, nothing)
        )
        assert torch.equal(some.references, others.references)
        steps = some.references - centre
        torch.testing.assert_close(steps, steps.round())
        assert not torch.equal(some.neighbour_bits, others.neighbour_bits)
    some.neighbour_bits.sum().backward()
    assert f.grad is None
    assert entropy.neighbour_network.follow.grad.abs().min() > 0
    assert all(p.grad is None for p in entropy.reference_network.parameters())
