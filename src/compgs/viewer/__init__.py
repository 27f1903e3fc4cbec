"""Scenes in a web page: a page that holds a file, its decoder and its viewer, and needs no server."""

from compgs.viewer.page import html_page

__all__ = ["html_page"]
