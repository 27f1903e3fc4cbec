"""One browser: where its camera is, what it wants to see, and the thread that keeps its picture up to date.

While anything changes the pictures are as small as they must be to be there in time; when all rests there is one of
full size. The thread waits for its turn to render; the web socket never does.
"""

import math
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import CancelledError
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from compgs.cameras import Camera
from compgs.errors import CompGSError
from compgs.metrics import to_8bit
from compgs.numerics.rotations import quaternion_from_rotation, rigid, rotation_from_quaternion
from compgs.render import render, settings_of
from compgs.viewer.pace import Pace
from compgs.viewer.shown import Shown, Vector
from compgs.viewer.stage import Stage

REST_SECONDS = 0.2  # without a change, until a picture of full size is due
MOVING_SECONDS = 0.07  # that a picture takes while the camera moves: 14 a second, less what sending takes
MAX_SIDE = 4096  # pixels of a picture


@dataclass(frozen=True, eq=False)
class Lens:
    """The camera of a page, in the model's local frame (OpenCV axes)."""

    position: np.ndarray  # [3]
    quaternion: np.ndarray  # [4] w-x-y-z, from camera to frame
    field_of_view: float  # radians, of the height
    width: int  # pixels of the canvas
    height: int

    def camera(self, share: float = 1.0) -> Camera:
        """Return the camera of pictures whose sides are this share of the canvas's."""
        share = min(share, MAX_SIDE / max(self.width, self.height))
        width, height = max(1, round(share * self.width)), max(1, round(share * self.height))
        rotation = rotation_from_quaternion(self.quaternion).T
        focal = height / (2 * math.tan(self.field_of_view / 2))
        pose = rigid(rotation, -rotation @ self.position)
        return Camera(pose, focal, focal, width / 2, height / 2, width, height)


def lens_of(camera: Camera, aspect: float | None = None) -> Lens:
    """The lens that sees what a camera does, on a canvas of an aspect (width / height) also more above or beside."""
    high, wide = camera.height / (2 * camera.fy), camera.width / (2 * camera.fx)
    tangent = high if aspect is None else max(high, wide / aspect)
    quaternion = quaternion_from_rotation(camera.rotation.T)
    return Lens(camera.center, quaternion, 2 * math.atan(tangent), camera.width, camera.height)


@dataclass(frozen=True)
class Look:
    """What a visitor wants to see, besides the camera."""

    level: int  # of `Shown.levels`
    background: Vector  # RGB, 0 to 1
    share: float = 1.0  # of the canvas's sides, at rest


@dataclass(frozen=True, eq=False)
class Picture:
    """What a page gets."""

    image: np.ndarray  # [H, W, 3] uint8
    full: bool
    seconds: float  # that it took
    drawn: int  # primitives in it
    counts: Mapping[str, int]  # what there is in the scene, as `Renderable.counts` says


class Page(Protocol):
    """What a visitor's thread needs of a browser."""

    def lens(self) -> Lens: ...

    def show(self, picture: Picture) -> None: ...

    def fail(self, message: str) -> None:
        """There will be no more pictures of this kind."""
        ...


@dataclass(eq=False)
class Visitor:
    """Call `changed` whenever something does; `work` is for a thread of its own, until `close`."""

    page: Page
    shown: Shown
    stage: Stage
    look: Look
    moving: Pace = field(default_factory=lambda: Pace(MOVING_SECONDS))
    resting: Pace = field(default_factory=lambda: Pace(math.inf))
    clock: Callable[[], float] = time.perf_counter

    def __post_init__(self) -> None:
        self._condition = threading.Condition()
        self._asked = 1  # changes so far
        self._drawn = 0  # changes that the last picture knew of
        self._full = False  # whether it was of full size
        self._rests_from = -math.inf
        self._closed = False

    def changed(self, *, moving: bool = True) -> None:
        """Another picture is wanted. `moving`: more of this is to be expected at once."""
        with self._condition:
            self._asked += 1
            if moving:
                self._rests_from = self.clock() + REST_SECONDS
            self._condition.notify_all()

    def wish(self, **parts: object) -> None:
        """Change the look."""
        self.look = replace(self.look, **parts)  # type: ignore[arg-type]
        self.changed()

    def close(self) -> None:
        with self._condition:
            self._closed = True
            self._condition.notify_all()

    def work(self) -> None:
        """Pictures for the page, until it is closed."""
        while self.wait():
            try:
                picture = self.stage.run(self.draw)
                self.page.show(picture)
            except CancelledError:
                return
            except (CompGSError, MemoryError) as error:
                self.page.fail(str(error) or "not enough memory")

    def wait(self) -> bool:
        """Wait until there is something to draw, and it rests or moves on; False: no more."""
        with self._condition:
            while not self._closed:
                left = self._rests_from - self.clock()
                if self._asked != self._drawn or (not self._full and left <= 0):
                    return True
                self._condition.wait(None if self._full else left)
            return False

    def draw(self) -> Picture:
        """The picture of this moment."""
        with self._condition:
            asked, full = self._asked, self.clock() >= self._rests_from
            self._drawn, self._full = asked, full
        look, pace = self.look, self.resting if full else self.moving
        start = self.clock()
        model = self.shown.model(look.level, fresh=full)
        camera = self.in_world(self.page.lens().camera(look.share * pace.share))
        result = render(model, camera, settings_of(model, look.background))
        image = to_8bit(result.image)
        seconds = self.clock() - start
        share = pace.share
        for each in (self.moving, self.resting):
            each.took(seconds, share)
        return Picture(image, full, seconds, int(result.visible.sum()), model.counts)

    def image(self, camera: Camera) -> np.ndarray:
        """[H, W, 3] uint8 of what this visitor looks at, from another camera, of the world."""

        def job() -> np.ndarray:
            model = self.shown.model(self.look.level, fresh=True)
            return to_8bit(render(model, camera, settings_of(model, self.look.background)).image)

        return self.stage.run(job)

    def in_world(self, camera: Camera) -> Camera:
        """A camera of the local frame, in which pages live."""
        return camera.moved(-np.array(self.shown.world_offset))

    def in_frame(self, camera: Camera) -> Camera:
        """Inverse of `in_world`."""
        return camera.moved(np.array(self.shown.world_offset))
