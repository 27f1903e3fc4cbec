"""Whether cameras took the photographs that they are said to have taken: points have the colors of their places there.

Photographs whose names were exchanged, or a model of other poses beside them, can be read like any capture. A training
then runs for an hour toward a blur. Points hidden by something else have other colors, so what says something is how
much more often colors are alike than between points and places that have nothing to do with each other.
"""

import numpy as np

from compgs.numerics.evenly import evenly
from compgs.scene.sight import inside, places_in
from compgs.scene.views import Scene

LOOKED_AT = 16  # training views, spread evenly over all
ALIKE = 12.0  # of 255, mean of the channels: light and noise change a color by so much
FEWEST = 500  # points in these views, so that chance does not decide
MOST_BY_CHANCE = 0.3  # of all pairs are alike: where a scene has one color, alikeness says nothing
# Eight captures have 2.5 to 10 times as many as by chance. With exchanged photographs six of them have 1.0 to 1.6
# times; one whose photographs all look alike has 2.3 (docs/results/hasty_captures.md#photographs-of-other-cameras).
LEAST_AGREEMENT = 1.8


def color_agreement(scene: Scene) -> float | None:
    """How many times as often as by chance a point of the scene has the color of its place in a training photograph.

    None where that says nothing: points are few or guessed, or colors alike everywhere. Raises UnreadableImage.
    """
    if scene.guessed or not scene.train_views:
        return None
    chance = np.random.default_rng(0)
    alike = by_chance = pairs = 0
    for view in (scene.train_views[i] for i in evenly(len(scene.train_views), LOOKED_AT)):
        column, row, depth = places_in(view.camera, scene.points.positions)
        there = (depth > 0) & inside(view.camera, column, row)
        seen = view.image[row[there].astype(int), column[there].astype(int)].astype(np.float32)
        expected = scene.points.colors[there].astype(np.float32)
        alike += _alike(seen, expected)
        by_chance += _alike(seen, chance.permutation(expected))
        pairs += len(expected)
    if pairs < FEWEST or by_chance > MOST_BY_CHANCE * pairs:
        return None
    return alike / max(1, by_chance)


def _alike(one: np.ndarray, other: np.ndarray) -> int:
    """Count the pairs of colors [N, 3] that are alike."""
    return int((np.abs(one - other).mean(1) < ALIKE).sum())
