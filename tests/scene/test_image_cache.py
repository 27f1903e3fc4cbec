"""Images in bounded memory, and scenes whose images do not fit."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from compgs.errors import UnreadableImage
from compgs.scene import images, load_scene
from compgs.scene.image_cache import ImageCache


class Reader:
    """Images of 100 bytes, and how often each was read."""

    def __init__(self) -> None:
        self.read: list[int] = []

    def __call__(self, key: int) -> np.ndarray:
        self.read.append(key)
        return np.full(100, key, np.uint8)


def test_what_was_looked_at_last_stays_and_the_longest_unused_goes() -> None:
    cache, reader = ImageCache(300), Reader()
    for key in (1, 2, 3, 1, 4, 1, 2):
        assert cache.get(key, lambda key=key: reader(key))[0] == key
        assert cache.bytes <= 300
    # 4 takes the place of 2, which was unused for longer than 1; 2 then takes that of 3.
    assert reader.read == [1, 2, 3, 4, 2]


def test_an_image_that_is_larger_than_the_cache_is_given_all_the_same() -> None:
    cache, reader = ImageCache(50), Reader()
    assert cache.get(1, lambda: reader(1))[0] == 1
    assert cache.get(1, lambda: reader(1))[0] == 1 and reader.read == [1]
    cache.get(2, lambda: reader(2))
    assert cache.bytes == 100


def test_threads_see_the_right_images_within_the_bound() -> None:
    cache = ImageCache(500)

    def look(i: int) -> bool:
        return int(cache.get(i % 7, lambda: np.full(100, i % 7, np.uint8))[0]) == i % 7

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(look, range(400)))
    assert cache.bytes <= 500


@pytest.fixture
def small_cache(monkeypatch: pytest.MonkeyPatch) -> list[ImageCache]:
    """Scenes are read with room for six of ten images."""
    made: list[ImageCache] = []

    def make() -> ImageCache:
        made.append(ImageCache(8_000))
        return made[-1]

    monkeypatch.setattr(images, "ImageCache", make)
    return made


def test_a_scene_that_does_not_fit_has_the_same_images_in_bounded_memory(
    write_capture: Callable[..., Path], small_cache: list[ImageCache]
) -> None:
    folder = write_capture()
    scene = load_scene(folder)
    (cache,) = small_cache
    assert cache.bytes == 0  # nothing is decoded before somebody looks
    views = (*scene.train_views, *scene.test_views)
    first = [view.image.copy() for view in views]
    assert all(np.array_equal(view.image, image) for view, image in zip(views, first, strict=True))
    assert 0 < cache.bytes <= 8_000 < sum(image.nbytes for image in first)
    assert all(
        image.shape == (view.camera.height, view.camera.width, 3)
        for view, image in zip(views, first, strict=True)
    )


def test_an_image_that_is_damaged_later_is_named_when_its_view_is_looked_at(
    write_capture: Callable[..., Path], small_cache: list[ImageCache]
) -> None:
    folder = write_capture()
    scene = load_scene(folder)
    view = scene.train_views[0]
    path = folder / "images" / view.name
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(UnreadableImage, match=view.name):
        _ = view.image
