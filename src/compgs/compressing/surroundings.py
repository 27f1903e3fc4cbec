"""Candidates for cameras of a scene of splats: around it, and inside of it.

How much of what is seen from points inside is scene, not background, says which kind of scene it is. An object is open
to all sides and one walks around it; a room is closed, and nobody looks at it from outside. So cameras look from
outside as far as the scene is open. An object that is hollow is closed, too, when one stands in it; but nothing far
belongs to it, and what is seen from within is seen from around as well.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from compgs.cameras import Camera
from compgs.compressing.probing import probe
from compgs.compressing.shape import Shape
from compgs.evaluation.camera_path import look_at
from compgs.model.splats import SplatModel

AROUND = (1.2, 2.4)  # radii from the middle, of cameras around the scene
INSIDE = (0.35, 1.0)  # radii from what a camera inside looks at
# Share of what is seen from inside that is scene: up to the first all cameras are around it, from the second on none.
OPEN, CLOSED = 0.25, 0.75
WITHIN = 0.8  # radii from the middle, at most, of a camera inside
ELEVATIONS = (-10.0, 75.0)  # degrees above the horizon, of most cameras
ANYWHERE = 0.25  # share of the cameras that are at any elevation: nobody said for sure where up is
ASIDE = 0.25  # radii, by which cameras around the scene look past its middle
PLACES = 8  # inside, from which it is asked how closed the scene is
LOOKS = 24  # from around, by which it is asked what is hidden from there
SEEN = 1e-3  # pixels of a probing picture, from which on a splat is in it
COMPACT = 1.8  # radii, within which nearly all of an object is
FEW_HIDDEN = 0.02  # of the splats that are seen from inside: so few are hidden from around
OBJECT = 0.8  # share of the cameras around an object that is not hollow
TRIES = 20  # for a place within the scene
AXES = (*np.eye(3), *-np.eye(3))


@dataclass(frozen=True)
class Lens:
    """Size and field of view of pictures."""

    width: int = 480  # pixels
    height: int = 360  # pixels
    field_of_view: float = 60.0  # degrees, of the longer side

    def camera(self, pose: np.ndarray) -> Camera:
        """Return the camera of a pose [4, 4], world to camera."""
        focal = max(self.width, self.height) / (2 * np.tan(np.deg2rad(self.field_of_view) / 2))
        return Camera(pose, focal, focal, self.width / 2, self.height / 2, self.width, self.height)


FACE = Lens(48, 48, 90.0)  # one of six that see everything


@dataclass(frozen=True, eq=False)
class Surroundings:
    """A scene, and what cameras for it are made of; every camera that is asked for takes of the same chance."""

    model: SplatModel
    shape: Shape
    lens: Lens
    up: np.ndarray  # [3] of length 1
    chance: np.random.Generator

    def candidates(self, count: int, outside: float) -> Iterator[Camera]:
        """`count` cameras that may see something, a share `outside` of them around the scene."""
        for _ in range(count):
            yield self.around() if self.chance.random() < outside else self.inside()

    def outside(self) -> float:
        """Share of the cameras that should stand around the scene."""
        closed, within = self.from_inside()
        free = float(np.clip((CLOSED - closed) / (CLOSED - OPEN), 0.0, 1.0))
        if free >= OBJECT or self.shape.reach > COMPACT * self.shape.radius:
            return free
        within &= self.shape.core
        hidden = within & ~self.from_around()
        if hidden.sum() > FEW_HIDDEN * within.sum():
            return free
        return 1.0 if closed >= CLOSED else max(OBJECT, free)

    def from_inside(self) -> tuple[float, np.ndarray]:
        """Share of all directions, from places inside, in which there is scene; and the splats seen there, [M] bool."""
        covered: list[float] = []
        seen = np.zeros(len(self.shape.means), dtype=bool)
        for _ in range(TRIES * PLACES):
            eye = self.inside().center - np.asarray(self.model.world_offset)
            faces = [probe(self.model, self.looking(eye, eye + axis, FACE)) for axis in AXES]
            if all(face.open for face in faces):
                covered.append(float(np.mean([min(1.0, face.covered) for face in faces])))
                for face in faces:
                    seen[face.splats[face.weights > SEEN]] = True
            if len(covered) == PLACES:
                break
        return (float(np.mean(covered)) if covered else 0.0), seen

    def from_around(self) -> np.ndarray:
        """[M] bool: splats that cameras on all sides of the scene see."""
        seen = np.zeros(len(self.shape.means), dtype=bool)
        for _ in range(LOOKS):
            looked = probe(self.model, self.around(anywhere=1.0))
            seen[looked.splats[looked.weights > SEEN]] = True
        return seen

    def around(self, anywhere: float = ANYWHERE) -> Camera:
        """Looks at the scene from outside, somewhat past its middle; see `direction`."""
        s = self.shape
        eye = s.middle + self.chance.uniform(*AROUND) * s.radius * self.direction(anywhere)
        return self.looking(eye, s.middle + ASIDE * s.radius * self.chance.normal(size=3))

    def inside(self) -> Camera:
        """Looks at some splat, a heavy one rather than a light one, from a place within the scene if that is soon
        found."""
        s = self.shape
        for _ in range(TRIES):
            target = s.means[np.searchsorted(s.cumulated, self.chance.random() * s.cumulated[-1])]
            distance = s.radius * np.exp(self.chance.uniform(*np.log(INSIDE)))
            eye = target + distance * self.direction()
            if np.linalg.norm(eye - s.middle) <= WITHIN * s.radius:
                break
        return self.looking(eye, target)

    def direction(self, anywhere: float = ANYWHERE) -> np.ndarray:
        """[3] of length 1, from something towards a camera that looks at it; a share `anywhere` of all knows no up."""
        if self.chance.random() < anywhere:
            free = self.chance.normal(size=3)
            return free / np.linalg.norm(free)
        side = np.cross(self.up, np.eye(3)[np.argmin(np.abs(self.up))])
        side /= np.linalg.norm(side)
        height = self.chance.uniform(*np.sin(np.deg2rad(ELEVATIONS)))  # equally often by area
        angle = self.chance.uniform(0, 2 * np.pi)
        level = np.cos(angle) * side + np.sin(angle) * np.cross(self.up, side)
        return height * self.up + np.sqrt(1 - height**2) * level

    def looking(self, eye: np.ndarray, target: np.ndarray, lens: Lens | None = None) -> Camera:
        """A camera of the world; eye and target are in the model's frame."""
        forward = (target - eye) / np.linalg.norm(target - eye)
        straight = abs(float(forward @ self.up)) > 0.999
        up = np.eye(3)[np.argmin(np.abs(self.up))] if straight else self.up
        camera = (lens or self.lens).camera(look_at(eye, target, up))
        return camera.moved(tuple(-x for x in self.model.world_offset))
