"""Images as notebooks show them."""

import base64
import html
import io
from collections.abc import Mapping, Sequence

import numpy as np
from PIL import Image

THUMBNAIL = 160  # pixels, longer side


def png(image: np.ndarray) -> bytes:
    """PNG of an image [H, W, 3]: uint8, or of floats from 0 to 1, which are clamped."""
    return _encoded(_picture(image), "PNG")


def table(title: str, facts: Mapping[str, object], images: Sequence[np.ndarray] = ()) -> str:
    """HTML: a title, a small table, and small pictures of images [H, W, 3]."""
    rows = "".join(
        f"<tr><th style='text-align: left'>{html.escape(name)}</th><td>{html.escape(str(value))}</td></tr>"
        for name, value in facts.items()
    )
    shown = "".join(_thumbnail(image) for image in images)
    return f"<b>{html.escape(title)}</b><table>{rows}</table><div>{shown}</div>"


def _thumbnail(image: np.ndarray) -> str:
    picture = _picture(image)
    picture.thumbnail((THUMBNAIL, THUMBNAIL))
    data = base64.b64encode(_encoded(picture, "JPEG")).decode("ascii")
    return f'<img alt="" style="display: inline; margin: 2px" src="data:image/jpeg;base64,{data}">'


def _picture(image: np.ndarray) -> Image.Image:
    if image.dtype != np.uint8:
        image = np.round(255 * np.clip(np.nan_to_num(image), 0, 1)).astype(np.uint8)
    return Image.fromarray(np.ascontiguousarray(image))


def _encoded(picture: Image.Image, kind: str) -> bytes:
    out = io.BytesIO()
    picture.save(out, kind)
    return out.getvalue()
