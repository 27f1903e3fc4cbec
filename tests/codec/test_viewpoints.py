"""The viewpoints section: its bytes, what it keeps, what is refused."""

import math
import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compgs.cameras import Camera
from compgs.codec.viewpoint_cameras import camera_from_viewpoint, viewpoints_from_cameras
from compgs.codec.viewpoints import Viewpoint, Viewpoints, decode_viewpoints, encode_viewpoints
from compgs.errors import CorruptSection, NotEncodable
from compgs.evaluation.camera_path import orbit

# By hand from the description. The box of the cameras is 0..4, 2..2, -1..3: middle (2, 2, 1), half its side 2.
EXAMPLE = Viewpoints(
    up=(0.0, 0.0, 1.0),
    views=(
        Viewpoint((1.0, 0.0, 0.0, 0.0), (0.0, 2.0, 3.0), 640, 480, 500.0, 501.5),
        Viewpoint((0.0, -1.0, 0.0, 0.0), (4.0, 2.0, -1.0), 640, 480, 500.0, 501.5),
        Viewpoint((0.8, 0.0, -0.6, 0.0), (2.5, 2.0, 1.0), 65535, 1, 1.0, 0.5),
    ),
)
EXAMPLE_BYTES = bytes.fromhex(
    "00007f"  # up x 127
    "00000040 00000040 0000803f 00000040"  # 2, 2, 1; radius 2
    "02"
    "8002 e001 0000fa43 00c0fa43"  # 640, 480, 500, 501.5
    "ffff 0100 0000803f 0000003f"  # 65535, 1, 1, 0.5
    "03"
    "00 0180 0000 ff7f 000000000000"  # (-1, 0, 1) x 32767; largest is w
    "00 ff7f 0000 0180 010000000000"  # largest is x, which becomes positive
    # 0.25 x 32767 = 8192 = 0x2000; the second of x, y, z is -0.6 x 23169.06 = -13901 = 0x49b3 in 15 bits, << 17
    "01 0020 0000 0000 000066930000"
)
LENS = (64, 48, 50.0, 50.0)

unit = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 1e-3)
lens = st.tuples(st.integers(1, 65535), st.integers(1, 65535), st.floats(1e-3, 1e6), st.floats(1e-3, 1e6))
lenses = st.lists(lens, min_size=1, max_size=16)


def normalized(vector: tuple[float, ...]) -> tuple[float, ...]:
    return tuple((np.array(vector) / np.linalg.norm(vector)).tolist())


@st.composite
def made(draw: st.DrawFn) -> Viewpoints:
    glass, size = draw(lenses), draw(st.sampled_from([1e-6, 1.0, 1e4]))
    middle = np.array(draw(st.tuples(*[st.floats(-10, 10)] * 3)))
    position = st.tuples(*[st.floats(-1, 1)] * 3)
    views = [
        Viewpoint(normalized(q), tuple((size * (middle + p)).tolist()), *glass[i % len(glass)])
        for i, (q, p) in enumerate(draw(st.lists(st.tuples(unit, position), min_size=1, max_size=20)))
    ]
    return Viewpoints(normalized(draw(unit.filter(lambda q: math.hypot(*q[:3]) > 1e-3))[:3]), tuple(views))


def angle(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    """Degrees between two rotations."""
    difference = min(np.linalg.norm(np.subtract(a, b)), np.linalg.norm(np.add(a, b)))
    return math.degrees(4 * math.asin(difference / 2))


def test_the_bytes_of_an_example_made_by_hand() -> None:
    assert encode_viewpoints(EXAMPLE) == EXAMPLE_BYTES
    found = decode_viewpoints(EXAMPLE_BYTES, "viewpoints")
    assert found.up == (0.0, 0.0, 1.0)
    assert [view.lens for view in found.views] == [view.lens for view in EXAMPLE.views]
    assert [view.center for view in found.views[:2]] == [(0.0, 2.0, 3.0), (4.0, 2.0, -1.0)]
    assert found.views[2].center == (2.0 + 2 * 8192 / 32767, 2.0, 1.0)
    assert found.views[1].rotation == (0.0, 1.0, 0.0, 0.0)
    np.testing.assert_allclose(found.views[2].rotation, (0.8, 0.0, -0.6, 0.0), atol=3e-5)


@given(made())
@settings(max_examples=150, deadline=None)
def test_what_is_decoded_is_near_to_what_was_encoded(viewpoints: Viewpoints) -> None:
    data = encode_viewpoints(viewpoints)
    found = decode_viewpoints(data, "viewpoints")
    positions = np.array([view.center for view in viewpoints.views])
    (radius,) = struct.unpack_from("<f", data, 15)
    if len(positions) > 1 and np.ptp(positions, axis=0).max() > max(1e-30, 1e-5 * np.abs(positions).max()):
        assert radius == pytest.approx(np.ptp(positions, axis=0).max() / 2, rel=0.2)  # no larger than needed
    assert len(found.views) == len(viewpoints.views)
    assert math.hypot(*found.up) == pytest.approx(1)
    assert np.dot(found.up, viewpoints.up) > math.cos(math.radians(0.5))
    for a, b in zip(found.views, viewpoints.views, strict=True):
        assert angle(a.rotation, b.rotation) < 0.02
        assert math.hypot(*a.rotation) == pytest.approx(1, abs=1e-12)
        assert np.linalg.norm(np.subtract(a.center, b.center)) < radius / 30000
        assert a.lens[:2] == b.lens[:2]
        np.testing.assert_allclose(a.lens[2:], b.lens[2:], rtol=1e-7)


@given(made())
@settings(max_examples=50, deadline=None)
def test_encoding_again_moves_no_more_than_a_step(viewpoints: Viewpoints) -> None:
    once = decode_viewpoints(encode_viewpoints(viewpoints), "viewpoints")
    again = decode_viewpoints(encode_viewpoints(once), "viewpoints")
    for a, b in zip(again.views, once.views, strict=True):
        assert angle(a.rotation, b.rotation) < 0.02
        assert a.lens == b.lens


@pytest.mark.parametrize("signs", [(1, 1, 1, 1), (-1, 1, -1, 1), (1, -1, -1, -1)])
@pytest.mark.parametrize("largest", range(4))
def test_rotations_whose_parts_are_equal_or_nearly_so_are_kept(largest: int, signs: tuple) -> None:
    for parts in ((0.5, 0.5, 0.5, 0.5), (math.sqrt(0.5), math.sqrt(0.5), 0, 0), (0.5001, 0.5, 0.5, 0.4999)):
        rotation = normalized(np.roll(np.array(parts) * signs, largest))
        view = Viewpoint(rotation, (1.0, 2.0, 3.0), *LENS)
        (found,) = decode_viewpoints(encode_viewpoints(Viewpoints((0, -1, 0), (view,))), "v").views
        assert angle(found.rotation, rotation) < 0.02


def test_one_camera_or_several_in_one_place_are_exactly_there_in_single_precision() -> None:
    views = tuple(Viewpoint((1.0, 0, 0, 0), (0.5, -3.0, 8.25), *LENS) for _ in range(3))
    found = decode_viewpoints(encode_viewpoints(Viewpoints((0, -1, 0), views)), "viewpoints")
    assert all(view.center == (0.5, -3.0, 8.25) for view in found.views)


@pytest.mark.parametrize("apart", [4e-45, 1e-40, 1e-30])
def test_cameras_hardly_apart_are_where_they_were(apart: float) -> None:
    views = tuple(Viewpoint((1.0, 0, 0, 0), (x, 0.0, 0.0), *LENS) for x in (0.0, apart))
    found = decode_viewpoints(encode_viewpoints(Viewpoints((0, -1, 0), views)), "viewpoints")
    assert abs(found.views[1].center[0] - apart) < 1e-34


def changed(offset: int, layout: str, *values: float) -> bytes:
    data = bytearray(EXAMPLE_BYTES)
    struct.pack_into(layout, data, offset, *values)
    return bytes(data)


FIRST_VIEW = 3 + 16 + 1 + 24 + 1


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (changed(0, "<3b", 0, 0, 0), "up is .* a direction"),
        (changed(0, "<b", -128), "up"),
        (changed(3, "<f", math.nan), "centre"),
        (changed(11, "<f", math.inf), "centre"),
        (changed(15, "<f", 0.0), "radius"),
        (changed(15, "<f", -1.0), "radius"),
        (changed(15, "<f", math.inf), "radius"),
        (changed(15, "<f", math.nan), "radius"),
        (changed(19, "<B", 0), "lens count is 0, expected 1 to 16"),
        (changed(19, "<B", 17), "lens count is 17"),
        (changed(20, "<H", 0), "size of a lens"),
        (changed(22, "<H", 0), "size of a lens"),
        (changed(24, "<f", 0.0), "focal"),
        (changed(28, "<f", math.nan), "focal"),
        (changed(28, "<f", math.inf), "focal"),
        (changed(24, "<f", -5.0), "focal"),
        (changed(44, "<B", 0), "view count is 0, expected 1 to 255"),
        (changed(FIRST_VIEW, "<B", 2), "lens of a view is 2, expected below 2"),
        (changed(FIRST_VIEW + 1, "<h", -32768), "position of a view"),
        (changed(FIRST_VIEW + 12, "<B", 0x80), "bit 47"),
        (EXAMPLE_BYTES + b"\0", "1 bytes are left over"),
        (changed(44, "<B", 255), "lens of a view needs 1 bytes"),
        (changed(44, "<B", 2), "13 bytes are left over"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_is_out_of_range_is_refused_by_name(data: bytes, words: str) -> None:
    with pytest.raises(CorruptSection, match=f"^look here: .*({words})"):
        decode_viewpoints(data, "look here")


@pytest.mark.parametrize("length", range(len(EXAMPLE_BYTES)))
def test_a_section_that_ends_early_is_refused(length: int) -> None:
    with pytest.raises(CorruptSection):
        decode_viewpoints(EXAMPLE_BYTES[:length], "viewpoints")


def rotated(*fields: int) -> bytes:
    """The example, the first view's rotation with these three numbers, w the largest."""
    bits = sum((field & 0x7FFF) << (2 + 15 * slot) for slot, field in enumerate(fields))
    return EXAMPLE_BYTES[: FIRST_VIEW + 7] + bits.to_bytes(6, "little") + EXAMPLE_BYTES[FIRST_VIEW + 13 :]


def test_rotations_that_no_unit_quaternion_has_are_refused() -> None:
    assert decode_viewpoints(rotated(16383, -11585, 0), "v").views[0].rotation[0] == pytest.approx(0.5, 1e-3)
    assert decode_viewpoints(rotated(11585, 11585, -11585), "v").views[0].rotation[0] > 0.4999
    for fields in ((16383, 16383, 0), (11586, 11586, 11586), (16383, 11590, 0)):
        with pytest.raises(CorruptSection, match="not the largest"):
            decode_viewpoints(rotated(*fields), "v")
    for slot in range(3):
        with pytest.raises(CorruptSection, match="-16383 or more"):
            decode_viewpoints(rotated(*np.roll([-16384, 0, 0], slot).tolist()), "v")


@given(st.binary(max_size=120))
@settings(max_examples=200, deadline=None)
def test_whatever_the_bytes_they_are_refused_or_sound(tail: bytes) -> None:
    for data in (tail, EXAMPLE_BYTES[:20] + tail, EXAMPLE_BYTES[:FIRST_VIEW] + tail):
        try:
            found = decode_viewpoints(data, "viewpoints")
        except CorruptSection:
            continue
        assert 1 <= len(found.views) <= 255
        for view in found.views:
            assert math.hypot(*view.rotation) == pytest.approx(1, abs=1e-9)
            assert np.isfinite(view.center).all() and min(view.lens) > 0


VIEW = EXAMPLE.views[0]


@pytest.mark.parametrize(
    ("viewpoints", "words"),
    [
        (replace(EXAMPLE, views=()), "0 views"),
        (replace(EXAMPLE, views=(VIEW,) * 256), "256 views"),
        (replace(EXAMPLE, up=(0.0, 0.0, 0.0)), "up"),
        (replace(EXAMPLE, up=(math.nan, 0.0, 0.0)), "up"),
        (replace(EXAMPLE, views=tuple(replace(VIEW, width=i + 1) for i in range(17))), "17 different lenses"),
        (replace(EXAMPLE, views=(replace(VIEW, width=0),)), "lens"),
        (replace(EXAMPLE, views=(replace(VIEW, height=65536),)), "lens"),
        (replace(EXAMPLE, views=(replace(VIEW, fx=1e39),)), "lens"),
        (replace(EXAMPLE, views=(replace(VIEW, fy=1e-60),)), "lens"),
        (replace(EXAMPLE, views=(replace(VIEW, center=(math.nan, 0.0, 0.0)),)), "position"),
        (replace(EXAMPLE, views=(VIEW, replace(VIEW, center=(1e39, 0.0, 0.0)))), "position"),
        (replace(EXAMPLE, views=(replace(VIEW, rotation=(0.0,) * 4),)), "rotation"),
        (replace(EXAMPLE, views=(replace(VIEW, rotation=(math.nan,) * 4),)), "rotation"),
    ],
)
def test_what_does_not_fit_is_not_written(viewpoints: Viewpoints, words: str) -> None:
    with pytest.raises(NotEncodable, match=words):
        encode_viewpoints(viewpoints)


def test_sixteen_lenses_and_255_views_fit() -> None:
    views = tuple(replace(VIEW, width=i % 16 + 1) for i in range(255))
    found = decode_viewpoints(encode_viewpoints(replace(EXAMPLE, views=views)), "viewpoints")
    assert [view.width for view in found.views] == [view.width for view in views]


# cameras -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (4.2e6, -5.1e5, 3e3)])
def test_cameras_of_the_world_come_back_through_the_file(offset: tuple[float, float, float]) -> None:
    positions = np.random.default_rng(0).normal(size=(50, 3))
    cameras = [c.moved(-np.array(offset)) for _, c in orbit(positions, frames=6, width=64, height=48)]
    viewpoints = viewpoints_from_cameras(cameras, (0.0, -1.0, 0.0), offset)
    assert np.abs([view.center for view in viewpoints.views]).max() < 10  # in the local frame
    found = decode_viewpoints(encode_viewpoints(viewpoints), "viewpoints")
    for a, view in zip(cameras, found.views, strict=True):
        b = camera_from_viewpoint(view, offset)
        np.testing.assert_allclose(b.center, a.center, rtol=0, atol=3e-4)
        np.testing.assert_allclose(b.rotation, a.rotation, atol=4e-4)
        assert (b.width, b.height, b.cx, b.cy) == (64, 48, 32.0, 24.0)
        assert b.fx == pytest.approx(a.fx, rel=1e-7)


def test_of_many_lenses_each_view_gets_a_similar_one() -> None:
    def camera(i: int) -> Camera:
        return Camera(np.eye(4), 100.0 + i, 100.0 + i, 32.0, 24.0, 64, 48)

    twins = [camera(i % 16) for i in range(16)] + [replace(camera(3), fx=103.4, fy=103.4)]
    found = viewpoints_from_cameras(twins, (0.0, -1.0, 0.0))
    assert found.views[16].lens == (64, 48, 103.0, 103.0)
    assert [view.fx for view in found.views[:16]] == [100.0 + i for i in range(16)]
    # The same field of view on an image of twice the size is nearer than another one on an image of the same size.
    wide = [camera(20 * i) for i in range(16)] + [camera(40).resized(128, 96)]
    assert viewpoints_from_cameras(wide, (0.0, -1.0, 0.0)).views[16].fx == 140.0
    encode_viewpoints(found)


def test_images_too_large_for_the_file_become_smaller() -> None:
    camera = Camera(np.eye(4), 1e5, 1e5, 5e4, 2.5e4, 100_000, 50_000)
    (view,) = viewpoints_from_cameras([camera], (0.0, -1.0, 0.0)).views
    assert (view.width, view.height) == (65535, 32767)
    assert view.fx == pytest.approx(65535) and view.fy == pytest.approx(65534)
