"""What lies in a scene's folder and is not used: said, not passed over."""

from collections.abc import Iterable
from pathlib import Path

from compgs.scene.colmap import count_images
from compgs.scene.doubt import ADJUSTMENT, GENERATED, REPORT

# Of photographs, also those that cannot be read.
SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp", ".heic", ".heif", ".avif", ".jp2")
# Files about a capture, not of it, by the beginning of their names.
ABOUT = ("license", "licence", "readme", "copying", "notice", "citation")
# What `compgs reconstruct`, `adjust`, `demo-scene` and file managers leave. COLMAP 4 writes which cameras are mounted
# on which rig; the poses of images hold all that a reader needs of it.
BYPRODUCTS = (
    *(REPORT, "reconstruction.png", ADJUSTMENT, GENERATED),
    *("thumbs.db", "desktop.ini"),
    *("rigs.bin", "frames.bin", "rigs.txt", "frames.txt"),
)
MOST_NAMED = 12
FEW = 3  # files of one folder that are named one by one


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


def unused_files(folder: Path, used: Iterable[Path], said: Iterable[Path] = ()) -> tuple[str, ...]:
    """A sentence that names everything in the folder of a scene that was not read, if there is anything.

    Folders of which nothing was read are named as a whole, many files of one folder are counted. `said`: folders whose
    photographs another sentence speaks of.
    """
    read = set(used)
    around = {parent for path in read for parent in path.parents}
    names = list(_unused_in(folder, folder, read, around, frozenset(said)))
    if not names:
        return ()
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return (f"not used: {', '.join(names[:MOST_NAMED])}{more}",)


def _unused_in(
    place: Path, folder: Path, read: set[Path], around: set[Path], said: frozenset[Path]
) -> Iterable[str]:
    files, folders, inside = [], [], []
    for entry in sorted(place.iterdir()):
        if entry.name.startswith(".") or entry in read or _is_about(entry):
            continue
        if entry in around:
            inside.append(entry)
        elif entry.is_dir():
            folders.append(entry)
        elif not (place in said and entry.suffix.lower() in SUFFIXES):
            files.append(entry)
    if len(files) > FEW and place != folder:
        example = files[0].relative_to(folder)
        yield f"{len(files)} files in {place.relative_to(folder)}/, such as {example.name}"
    else:
        yield from (str(file.relative_to(folder)) for file in files)
    yield from (f"{entry.relative_to(folder)}/" for entry in folders if entry not in said)
    for entry in inside:
        yield from _unused_in(entry, folder, read, around, said | {entry} if place in said else said)


def _is_about(file: Path) -> bool:
    name = file.name.lower()
    return name in BYPRODUCTS or (name.startswith(ABOUT) and file.is_file())


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
