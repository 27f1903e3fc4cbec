"""Scenes in a browser: pages that need no server (page, gallery), and a viewer that this process renders for (live)."""

from compgs.extras import require
from compgs.viewer.page import html_page

__all__ = ["check_viewer", "html_page"]


def check_viewer() -> None:
    """Raises MissingDependency, with the remedy, where no live viewer can be opened."""
    require("view", "the viewer")
