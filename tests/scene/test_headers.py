"""Headers of photographs say how much light was let in."""

from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from compgs.cameras import Camera
from compgs.scene.capture import PosedImage
from compgs.scene.images import load_views, stops_of


def photograph(path: Path, **tags: object) -> Path:
    exif = Image.Exif()
    details = exif.get_ifd(ExifTags.IFD.Exif)
    for name, value in tags.items():
        details[ExifTags.Base[name]] = value
    Image.fromarray(np.zeros((6, 8, 3), np.uint8)).save(path, exif=exif)
    return path


def test_twice_the_time_or_the_sensitivity_is_a_stop_and_the_next_f_number_half_of_one(
    tmp_path: Path,
) -> None:
    usual = {"ExposureTime": IFDRational(1, 100), "ISOSpeedRatings": 200, "FNumber": 2.0}
    stops = stops_of(photograph(tmp_path / "usual.jpg", **usual))
    assert stops == pytest.approx(np.log2(0.01 * 200 / 4))
    for name, change, expected in (
        ("longer", {"ExposureTime": IFDRational(1, 50)}, 1.0),
        ("darker", {"ISOSpeedRatings": 50}, -2.0),
        ("wider", {"FNumber": 1.0}, 2.0),
    ):
        found = stops_of(photograph(tmp_path / f"{name}.jpg", **(usual | change)))
        assert found is not None and found - stops == pytest.approx(expected, abs=1e-6)


def test_headers_that_do_not_say_enough_say_nothing(tmp_path: Path) -> None:
    assert stops_of(photograph(tmp_path / "none.jpg")) is None
    assert stops_of(photograph(tmp_path / "time.jpg", ExposureTime=IFDRational(1, 100))) is None
    zero = photograph(tmp_path / "zero.jpg", ExposureTime=IFDRational(0, 1), ISOSpeedRatings=100)
    assert stops_of(zero) is None


def test_a_phone_that_leaves_its_aperture_out_is_understood(tmp_path: Path) -> None:
    path = photograph(tmp_path / "phone.jpg", ExposureTime=IFDRational(1, 4), ISOSpeedRatings=100)
    assert stops_of(path) == pytest.approx(np.log2(25))


def test_views_say_what_their_headers_do(tmp_path: Path) -> None:
    path = photograph(tmp_path / "a.jpg", ExposureTime=IFDRational(1, 2), ISOSpeedRatings=100)
    camera = Camera(np.eye(4), 5.0, 5.0, 4.0, 3.0, 8, 6)
    (view,), _ = load_views([PosedImage("a.jpg", path, camera)], 1, None)
    assert view.stops == pytest.approx(np.log2(50))
