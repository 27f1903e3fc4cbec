"""The page that holds a scene: what goes into it, and that it needs nothing else."""

import base64
import re

from compgs.viewer import html_page

DATA = bytes(range(256)) * 3


def embedded(page: bytes) -> bytes:
    found = re.search(rb'<script id="scene"[^>]*>([^<]*)</script>', page)
    assert found is not None
    return base64.b64decode(found[1], validate=True)


def test_a_page_holds_the_file_as_it_is() -> None:
    assert embedded(html_page(DATA, "a scene")) == DATA


def test_a_page_without_a_file_holds_nothing() -> None:
    assert embedded(html_page(b"", "")) == b""


def test_a_title_is_text_even_if_it_looks_like_html() -> None:
    page = html_page(DATA, "</title><script>alert(1)</script> {{data}}").decode()
    assert "<title>&lt;/title&gt;&lt;script&gt;alert(1)&lt;/script&gt; {{data}}</title>" in page
    assert embedded(page.encode()) == DATA


def test_a_page_asks_nothing_of_the_network() -> None:
    page = html_page(DATA, "a scene").decode()
    assert not re.search(r"""https?://|<img|@import|\bsrc=|href="(?!data:)""", page)


def test_a_page_is_smaller_than_400_kilobytes_without_its_scene() -> None:
    assert len(html_page(b"", "")) < 400_000
