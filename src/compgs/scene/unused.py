"""What lies in a scene's folder and is not used: said, not passed over."""

from collections.abc import Iterable
from pathlib import Path

from compgs.scene.colmap import count_images

# Of photographs, also those that cannot be read.
SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp", ".heic", ".heif", ".avif", ".jp2")


def unposed_photographs(folder: Path, used: Iterable[Path]) -> tuple[str, ...]:
    """A sentence if photographs in the folder of the images have no pose: structure from motion did not place them."""
    if not folder.is_dir():
        return ()
    posed = {path.relative_to(folder) for path in used if path.is_relative_to(folder)}
    found = {p.relative_to(folder) for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file()}
    missing = sorted(found - posed)
    if not missing or not posed:
        return ()
    count = f"{len(missing)} photograph{'s have' if len(missing) > 1 else ' has'} no pose and"
    return (f"{folder.name}/: {count} will not be used, such as {missing[0]}",)


def larger_models(sparse: Path, registered: int) -> tuple[str, ...]:
    """A sentence if beside the sparse model that is read there is one of more images, as COLMAP numbers them."""
    if not sparse.name.isdigit():
        return ()
    others = {
        path: count_images(path) for path in sparse.parent.iterdir() if path.name.isdigit() and path != sparse
    }
    largest = max(others, key=others.__getitem__, default=None)
    if largest is None or others[largest] <= registered:
        return ()
    return (
        f"{sparse.parent.name}/{sparse.name} is read, with {registered} images; {sparse.parent.name}/{largest.name} "
        f"has {others[largest]}: to use that one, swap the two folders' names",
    )
