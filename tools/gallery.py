"""Makes the pages of the site's gallery while mkdocs builds it: one web page for each .cgs file of docs/gallery.

mkdocs.yml names this file as a hook. Each page holds the scene, the decoder and the viewer, as `compgs export FILE
page.html` writes it.
"""

from pathlib import Path
from typing import Any

from compgs.outputs import write_bytes
from compgs.viewer.page import html_page

GALLERY = Path(__file__).resolve().parents[1] / "docs" / "gallery"


def on_post_build(config: Any) -> None:
    """Write the pages into the site that was built."""
    folder = Path(config["site_dir"]) / "gallery"
    for file in sorted(GALLERY.glob("*.cgs")):
        write_bytes(folder / f"{file.stem}.html", html_page(file.read_bytes(), file.stem))
