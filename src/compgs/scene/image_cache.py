"""Images in bounded memory: decoded when somebody looks, kept while there is room, the longest unused go first."""

from collections import OrderedDict
from collections.abc import Callable
from threading import Lock
from typing import Generic, Protocol, TypeVar


class Sized(Protocol):
    """An image, or several."""

    @property
    def nbytes(self) -> int: ...


_Image = TypeVar("_Image", bound=Sized)

# Of decoded images of a scene, 3 bytes a pixel: 350 views of 12 megapixels at a quarter of their size. Of a larger
# capture images are decoded again when their view comes, which takes less than the training step on that view.
MOST_BYTES = 1 << 30


class ImageCache(Generic[_Image]):
    """Decoded images by key, at most so many bytes of them, but always the last one. For use by several threads."""

    def __init__(self, most_bytes: int = MOST_BYTES) -> None:
        self.most_bytes = most_bytes
        self.bytes = 0
        self._images: OrderedDict[int, _Image] = OrderedDict()
        self._lock = Lock()

    def get(self, key: int, read: Callable[[], _Image]) -> _Image:
        """The image of a key, by `read` if it is not there (any more)."""
        with self._lock:
            if key in self._images:
                self._images.move_to_end(key)
                return self._images[key]
        image = read()
        with self._lock:
            if key not in self._images:
                self._images[key] = image
                self.bytes += image.nbytes
            while self.bytes > self.most_bytes and len(self._images) > 1:
                self.bytes -= self._images.popitem(last=False)[1].nbytes
        return image
