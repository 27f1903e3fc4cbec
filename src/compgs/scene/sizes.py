"""In which size, and which way up, the photographs of a capture are read."""

from dataclasses import replace
from pathlib import Path

from compgs.scene.capture import Capture, PosedImage
from compgs.scene.images import downscaled_size, image_size, stored_size, turned_as_cameras_are
from compgs.scene.names import Names

AUTO = "auto"
LARGE = 2_000_000  # pixels of a photograph, from which `downscale="auto"` reduces
LONGEST_SIDE = 1_600  # pixels that it leaves of the longer side, as 3DGS does


def turned(capture: Capture) -> Capture:
    """Turn images by their orientation tag where their cameras are of turned ones, and say so in a note."""
    images = turned_as_cameras_are(capture.images)
    count = sum(posed.turned for posed in images)
    if not count:
        return capture
    note = f"{count} of {len(images)} photographs are turned by their orientation tag: so their cameras are"
    return replace(capture, images=images, notes=(*capture.notes, note))


def sized(
    capture: Capture, folder: Path, images: str, downscale: int | str
) -> tuple[Capture, float, tuple[str, ...]]:
    """The capture, the factor by which its images are to be reduced, and what is to be noted."""
    if downscale != AUTO:
        return *_prescaled(capture, folder, images, int(downscale)), ()
    largest = max(
        (image_size(posed.path) for posed in capture.images if posed.path.is_file()),
        key=lambda size: size[0] * size[1],
        default=(1, 1),
    )
    if largest[0] * largest[1] <= LARGE or max(largest) <= LONGEST_SIDE:
        return capture, 1, ()
    factor = max(largest) / LONGEST_SIDE
    width, height = downscaled_size(largest, factor)
    note = (
        f"photographs of {largest[0]} x {largest[1]} pixels are read at {width} x {height} (downscale=auto); "
        "downscale=1 reads all their pixels"
    )
    return capture, factor, (note,)


def _prescaled(capture: Capture, folder: Path, images: str, downscale: int) -> tuple[Capture, int]:
    """Takes the images from `images_<downscale>` where that folder has all of them in the promised size."""
    smaller = folder / f"{images}_{downscale}"
    if downscale == 1 or not smaller.is_dir():
        return capture, downscale
    swapped, names = [], Names()
    for posed in capture.images:
        if not posed.path.is_relative_to(folder / images):
            return capture, downscale
        name = posed.path.relative_to(folder / images).as_posix()
        path = names.find(smaller, name)
        if path is None or not _is_smaller_copy(posed, path, downscale):
            note = f"{smaller.name} is not used: {Path(name).name} is missing there or not 1/{downscale} of its size"
            return replace(capture, notes=(*capture.notes, note)), downscale
        swapped.append(replace(posed, path=path, turned=False))
    return replace(capture, images=turned_as_cameras_are(swapped)), 1


def _is_smaller_copy(posed: PosedImage, path: Path, downscale: int) -> bool:
    size, sideways = stored_size(path)
    camera = posed.camera
    return any(
        abs(width - camera.width / downscale) <= 1 and abs(height - camera.height / downscale) <= 1
        for width, height in (size, size[::-1])[: 1 + sideways]
    )
