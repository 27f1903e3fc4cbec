"""Vectors as entries of a codebook: learned by k-means or by moving averages, in one stage or several.

Vectors are [M, C], a codebook is [K, C] with K at most M, labels are [M] int64. Weights [M] say how much an error of
each vector matters: they move the codes. Which code is nearest does not depend on them, as a weight multiplies a
vector's distances to all codes alike.

Everything is computed in the same order each time: on the same CPU the same vectors give the same codes.
"""

import torch
from torch import Tensor

MOST_DISTANCES = 1 << 18  # computed at once: 1 MB, which caches hold
MOST_WHOLE_STEPS = (
    40  # of moving averages where each batch is all vectors: they are the same ones again and again
)


@torch.no_grad()
def nearest_codes(vectors: Tensor, codes: Tensor) -> Tensor:
    """[M] int64: the code of the smallest distance to each vector; the first, of equally near ones."""
    middle = codes.mean(
        0
    )  # subtracted: squares of values far from zero would leave no digits for their differences
    centered = codes - middle
    squares = (centered**2).sum(1)
    rows = max(1, MOST_DISTANCES // len(codes))
    parts = [
        torch.addmm(squares, part - middle, centered.T, alpha=-2.0).argmin(1) for part in vectors.split(rows)
    ]
    return torch.cat(parts) if parts else torch.zeros(0, dtype=torch.int64, device=vectors.device)


@torch.no_grad()
def code_means(
    vectors: Tensor,
    labels: Tensor,
    codes: Tensor,  # what stays where no vector has a label
    weights: Tensor | None = None,
) -> Tensor:  # [K, C]
    """The (weighted) mean of the vectors of each label."""
    sums, mass = _sums(vectors, labels, len(codes), weights)
    return torch.where(
        (mass > 0)[:, None], sums / mass.clamp_min(torch.finfo(mass.dtype).tiny)[:, None], codes
    )


@torch.no_grad()
def first_codes(vectors: Tensor, count: int, chance: torch.Generator) -> Tensor:
    """`count` of the vectors, by chance, each at most once; all of them if there are no more."""
    rows = torch.randperm(len(vectors), generator=chance, device=chance.device)[:count]
    return vectors[rows.to(vectors.device)].clone()


@torch.no_grad()
def k_means(
    vectors: Tensor, codes: Tensor, rounds: int, weights: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Codes after so many rounds (Lloyd 1982), and the labels of the vectors by them."""
    for _ in range(rounds):
        codes = code_means(vectors, nearest_codes(vectors, codes), codes, weights)
    return codes, nearest_codes(vectors, codes)


@torch.no_grad()
def averaged_codes(
    vectors: Tensor,
    codes: Tensor,
    steps: int,
    chance: torch.Generator,
    *,
    weights: Tensor | None = None,
    decay: float = 0.8,  # of what a code has seen so far, a step
    batch: int = 1 << 18,  # vectors a step; all of them if there are no more
    reseeded: int = 0,  # codes a step, those with the least weight, that begin again at vectors chosen by chance
) -> Tensor:  # [K, C]
    """Codes that are moving averages of the (weighted) vectors they were nearest to, batch by batch.

    A code that no vector of a batch is near stays where it is, and its weight fades.
    """
    codes = codes.clone()
    steps = steps if batch < len(vectors) else min(steps, MOST_WHOLE_STEPS)
    mass = torch.zeros(len(codes), dtype=vectors.dtype, device=vectors.device)
    for step in range(steps):
        if batch < len(vectors):
            rows = torch.randint(len(vectors), (batch,), generator=chance, device=chance.device)
            rows = rows.to(vectors.device)
            some, w = vectors[rows], None if weights is None else weights[rows]
        else:
            some, w = vectors, weights
        sums, added = _sums(some, nearest_codes(some, codes), len(codes), w)
        mass, before = decay * mass + (1 - decay) * added, decay * mass
        moved = (before[:, None] * codes + (1 - decay) * sums) / mass.clamp_min(torch.finfo(mass.dtype).tiny)[
            :, None
        ]
        codes = torch.where((added > 0)[:, None], moved, codes)
        if reseeded and step + 1 < steps:
            emptiest = torch.sort(mass, stable=True).indices[:reseeded]
            codes[emptiest] = first_codes(vectors, len(emptiest), chance)
    return codes


# several stages ----------------------------------------------------------------------------------------------------


@torch.no_grad()
def residual_codes(
    vectors: Tensor, stages: int, count: int, rounds: int, chance: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Codebooks [S, K, C] and labels [M, S]: each stage codes what the stages before it left (by k-means)."""
    books, left = [], vectors
    for _ in range(stages):
        codes, labels = k_means(left, first_codes(left, count, chance), rounds)
        books.append(codes)
        left = left - codes[labels]
    return torch.stack(books), residual_labels(vectors, torch.stack(books))


@torch.no_grad()
def residual_labels(vectors: Tensor, books: Tensor) -> Tensor:
    """[M, S] int64: of each stage the code that is nearest to what the stages before left."""
    labels = []
    for codes in books:
        labels.append(nearest_codes(vectors, codes))
        vectors = vectors - codes[labels[-1]]
    return torch.stack(labels, 1)


def residual_sums(books: Tensor, labels: Tensor) -> Tensor:
    """[M, C]: the vectors that labels [M, S] of codebooks [S, K, C] stand for; differentiable by the codebooks."""
    return torch.stack([codes[labels[:, stage]] for stage, codes in enumerate(books)]).sum(0)


def _sums(vectors: Tensor, labels: Tensor, count: int, weights: Tensor | None) -> tuple[Tensor, Tensor]:
    """Sums [K, C] of the (weighted) vectors of each label, and of their weights [K]."""
    mass = vectors.new_zeros(count)
    w = vectors.new_ones(len(vectors)) if weights is None else weights.to(vectors.dtype)
    mass.index_add_(0, labels, w)
    weighted = vectors if weights is None else vectors * w[:, None]
    return vectors.new_zeros(count, vectors.shape[1]).index_add_(0, labels, weighted), mass
