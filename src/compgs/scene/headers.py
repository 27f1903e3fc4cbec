"""What a photograph's header (EXIF) says of how it was exposed."""

import math

from PIL import ExifTags, Image


def stops_in(exif: Image.Exif) -> float | None:
    """Log2 of the light that was let in, from time, sensitivity and aperture; None where the header does not say.

    Light is the time times the sensitivity over the square of the f-number. A phone's aperture is fixed, and its header
    may leave it out: then it counts as 1.
    """
    details = exif.get_ifd(ExifTags.IFD.Exif)
    seconds = _positive(details.get(ExifTags.Base.ExposureTime))
    sensitivity = _positive(details.get(ExifTags.Base.ISOSpeedRatings))
    if seconds is None or sensitivity is None:
        return None
    f_number = _positive(details.get(ExifTags.Base.FNumber)) or 1.0
    return math.log2(seconds) + math.log2(sensitivity) - 2.0 * math.log2(f_number)


def _positive(value: object) -> float | None:
    """The number in a tag, which some cameras write as a list of one; None for what is none."""
    if isinstance(value, tuple | list) and value:
        value = value[0]
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if 0.0 < number < math.inf else None
