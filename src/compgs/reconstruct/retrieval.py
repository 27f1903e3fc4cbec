"""Which photographs are worth comparing: neighbours by name, and those that look alike.

To compare each with each takes a time that grows with the square of their number, and most pairs show nothing in
common. A photograph's local features say what it looks like as a whole: VLAD (Jégou et al. 2010) sums, for each of some
words of a vocabulary, how far the features of that word lie from it. The vocabulary is made of the photographs' own
features, so that nothing is to be downloaded.
"""

import numpy as np

WORDS = 64  # of the vocabulary
SAMPLED = 300  # features of a photograph, at most, that the vocabulary is made of
ROUNDS = 12  # of k-means
NEAR = 3  # neighbours by name on each side: people walk, and names follow the time
ALIKE = 12  # that each photograph is compared with for its looks
AT_ONCE = 4096  # features whose words are found together


def pairs_to_compare(
    descriptors: list[np.ndarray],  # of each photograph, in the order of the names: [F, 128], any scale
    near: int = NEAR,
    alike: int = ALIKE,
    seed: int = 0,
) -> list[tuple[int, int]]:
    """Pairs of photographs, each once, the smaller number first, in order."""
    count = len(descriptors)
    pairs = {
        (first, second) for first in range(count) for second in range(first + 1, min(count, first + near + 1))
    }
    looks = global_descriptors(descriptors, seed)
    similarity = looks @ looks.T
    np.fill_diagonal(similarity, -np.inf)
    for first, row in enumerate(similarity):
        order = np.argsort(-row, kind="stable")[: min(alike, count - 1)]
        pairs |= {(min(first, int(second)), max(first, int(second))) for second in order}
    return sorted(pairs)


def global_descriptors(descriptors: list[np.ndarray], seed: int = 0) -> np.ndarray:
    """[V, WORDS * 128] of length 1 each: the closer two are, the more alike the photographs."""
    features = [unit(each) for each in descriptors]
    chance = np.random.default_rng(seed)
    sampled = [each[chance.permutation(len(each))[:SAMPLED]] for each in features]
    words = vocabulary(np.concatenate(sampled), chance)
    return np.stack([vlad(each, words) for each in features])


def unit(features: np.ndarray) -> np.ndarray:
    """[F, D] -> [F, D] float32 of length 1; what has none stays zero."""
    floats = features.astype(np.float32)
    return floats / np.maximum(np.linalg.norm(floats, axis=1, keepdims=True), 1e-12)


def vocabulary(features: np.ndarray, chance: np.random.Generator) -> np.ndarray:
    """[WORDS, D] by k-means of features [F, D] of length 1, or of fewer features as many."""
    words = features[chance.permutation(len(features))[:WORDS]].copy()
    for _ in range(ROUNDS):
        of_word = nearest_word(features, words)
        for word in range(len(words)):
            own = features[of_word == word]
            if len(own):
                words[word] = own.mean(axis=0)
    return words


def nearest_word(features: np.ndarray, words: np.ndarray) -> np.ndarray:
    """[F] int64."""
    halves = 0.5 * (words**2).sum(axis=1)
    parts = [features[i : i + AT_ONCE] @ words.T - halves for i in range(0, len(features), AT_ONCE)]
    return np.concatenate([part.argmax(axis=1) for part in parts]) if parts else np.zeros(0, np.int64)


def vlad(features: np.ndarray, words: np.ndarray) -> np.ndarray:
    """[F, D] -> [WORDS * D] of length 1; each word's part has the same length, else a wall of bricks would be all."""
    of_word, sums = nearest_word(features, words), np.zeros_like(words)
    np.add.at(sums, of_word, features - words[of_word])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
    flat = sums.ravel()
    return flat / max(float(np.linalg.norm(flat)), 1e-12)
