"""Names of photographs, as files of poses have them, and the files on disk that they mean: one way for all layouts.

A name is relative to a folder. Programs write it with "/" or, on Windows, with "\\"; with a leading "./"; without the
suffix of the file, or with another one, where photographs were converted since; with accents composed or decomposed
(macOS stores "é" as two characters); in other letter case, as file systems of Windows and macOS allow. The file that is
spelled exactly so goes before all others.
"""

import unicodedata
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePosixPath

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")


def as_name(path: str) -> str:
    """A path as the names of views are written."""
    return path.replace("\\", "/").removeprefix("./")


def folded(name: str) -> str:
    """The same for names that differ in their Unicode form or in letter case."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", as_name(name)).casefold())


class Names:
    """Files by their names. Each folder is listed once, when it is first asked for."""

    def __init__(self) -> None:
        self._listings: dict[Path, Mapping[str, tuple[str, ...]]] = {}

    def find(self, folder: Path, name: str, suffixes: tuple[str, ...] = IMAGE_SUFFIXES) -> Path | None:
        """The file in `folder` that `name` means, perhaps without one of the `suffixes`; None where there is none.

        A name that leads out of the folder is not followed.
        """
        exact = folder / name
        if exact.is_file():
            return exact
        *folders, last = PurePosixPath(as_name(name)).parts or ("",)
        if ".." in folders or last in ("", "..") or PurePosixPath(as_name(name)).is_absolute():
            return None
        place = folder
        for part in folders:
            found = self._entry(place, part)
            if found is None:
                return None
            place = found
        stem = without_suffix(last)
        # Photographs that were saved again as another format, last.
        converted = [stem + suffix for suffix in suffixes] if stem != last else []
        for spelled in (last, *(last + suffix for suffix in suffixes), *converted):
            found = self._entry(place, spelled)
            if found is not None and found.is_file():
                return found
        return None

    def _entry(self, folder: Path, name: str) -> Path | None:
        """What is called so in a folder: exactly, else in another Unicode form or letter case, if it is but one."""
        alike = self._listing(folder).get(folded(name), ())
        if name in alike:
            return folder / name
        composed = unicodedata.normalize("NFC", name)
        same = [other for other in alike if unicodedata.normalize("NFC", other) == composed] or alike
        return folder / same[0] if len(same) == 1 else None

    def _listing(self, folder: Path) -> Mapping[str, tuple[str, ...]]:
        if folder not in self._listings:
            listing: dict[str, tuple[str, ...]] = {}
            try:
                entries = sorted(entry.name for entry in folder.iterdir())
            except OSError:
                entries = []
            for entry in entries:
                listing[folded(entry)] = (*listing.get(folded(entry), ()), entry)
            self._listings[folder] = listing
        return self._listings[folder]


def matches(named: Iterable[str], names: Iterable[str]) -> dict[str, str]:
    """Return the names in a list that mean one of `names` -> which one: with the tolerance of `Names`."""
    exact, alike = set(names), dict[str, str]()
    for name in sorted(exact):
        alike.setdefault(folded(name), name)
        alike.setdefault(folded(without_suffix(name)), name)
    found = {}
    for name in named:
        spelled = as_name(name)
        ways = (alike.get(folded(spelled)), alike.get(folded(without_suffix(spelled))))
        match = spelled if spelled in exact else next((way for way in ways if way), None)
        if match is not None:
            found[name] = match
    return found


def without_suffix(name: str) -> str:
    """The name without the suffix of an image, if it has one: `frame.0001` has none."""
    stem, dot, suffix = name.rpartition(".")
    return stem if dot and f".{suffix.lower()}" in IMAGE_SUFFIXES else name


def in_other_formats(named: Iterable[tuple[str, Path]]) -> tuple[str, ...]:
    """A sentence if some of the files (by the name that means them) are of other formats than their names say."""
    other = [
        (name, path)
        for name, path in named
        if path.is_file()
        and without_suffix(name) != name
        and PurePosixPath(name).suffix.lower() != path.suffix.lower()
    ]
    if not other:
        return ()
    name, path = other[0]
    return (
        f"{len(other)} photographs have another suffix than in the poses, such as {path.name} for {name}",
    )
