"""The page as people use it: mouse, keys and touch, in a window and on a phone; what it says when it cannot show."""

import base64
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from compgs.viewer import html_page

from .devtools import Page, tab, until
from .test_picture import CONTENTS, written

pytestmark = pytest.mark.slow
DESK, PHONE = (1280, 800), (390, 844)
IS_SHOWN = "document.getElementById('status').textContent.includes(' in ')"
IS_AT_REST = "!compgsViewer.controls.isBusy && !compgsViewer.isMoving"
FORWARD = "compgsViewer.controls.target.pose.forward"
CENTRE = "compgsViewer.controls.target.pose.centre"
DISTANCE = "compgsViewer.controls.target.distance"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("page") / "scene.html"
    file.write_bytes(html_page(written(replace(CONTENTS["paired"], background=(0.0, 0.0, 0.0))), "a scene"))
    return file


@pytest.fixture(scope="module")
def desk(browser: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with tab(browser, tmp_path_factory.mktemp("browser"), *DESK) as page:
        yield page


@pytest.fixture
def opened(desk: Page, scene: Path) -> Page:
    show(desk, scene)
    return desk


def show(page: Page, file: Path) -> None:
    page.open("about:blank")
    page.open(file.as_uri())
    until(lambda: page.ask(IS_SHOWN), "the scene")


def at_rest(page: Page) -> None:
    """Wait until the camera rests, and still does a moment later: on a busy machine an event may be on its way."""

    def rests() -> bool:
        if not page.ask(IS_AT_REST):
            return False
        time.sleep(0.2)
        return bool(page.ask(IS_AT_REST))

    until(rests, "rest")


def numbers(page: Page, expression: str) -> np.ndarray:
    return np.array(page.ask(f"[...{expression}]"))


def key(page: Page, code: str, name: str, seconds: float = 0.4) -> None:
    page.call("Input.dispatchKeyEvent", type="keyDown", code=code, key=name)
    time.sleep(seconds)
    page.call("Input.dispatchKeyEvent", type="keyUp", code=code, key=name)


def click_twice(page: Page, at: tuple[int, int]) -> None:
    for _ in range(2):
        page._mouse("mousePressed", at)
        page._mouse("mouseReleased", at)


def is_hidden(page: Page, name: str) -> bool:
    return bool(page.ask(f"document.getElementById('{name}').hidden"))


def test_keys_move_before_a_click_and_after_a_button(opened: Page) -> None:
    before = numbers(opened, CENTRE)
    key(opened, "KeyW", "w")
    at_rest(opened)
    ahead = numbers(opened, CENTRE)
    assert np.dot(ahead - before, numbers(opened, FORWARD)) > 0
    opened.ask("document.getElementById('mode').focus(); document.getElementById('mode').click()")
    key(opened, "KeyS", "s")
    at_rest(opened)
    assert np.dot(numbers(opened, CENTRE) - ahead, numbers(opened, FORWARD)) < 0


def test_a_movement_runs_out_and_the_picture_is_then_of_full_size(opened: Page) -> None:
    x, y = DESK[0] // 2, DESK[1] // 2
    opened.drag((x, y), (x + 150, y))
    at_rest(opened)
    first = numbers(opened, FORWARD)
    time.sleep(0.5)
    assert np.array_equal(numbers(opened, FORWARD), first)
    width, height = opened.ask("[compgsViewer.canvas.width, compgsViewer.canvas.height]")
    assert (width, height) == (opened.ask("innerWidth"), opened.ask("innerHeight"))


def test_pictures_are_smaller_while_somebody_moves_and_frames_are_late(opened: Page) -> None:
    opened.ask("compgsViewer.pace.share = 0.25")
    opened.call("Input.dispatchKeyEvent", type="keyDown", code="KeyD", key="d")
    until(lambda: opened.ask("compgsViewer.canvas.width < innerWidth"), "a smaller picture")
    opened.call("Input.dispatchKeyEvent", type="keyUp", code="KeyD", key="d")
    until(lambda: opened.ask("compgsViewer.canvas.width === innerWidth"), "a sharp picture")


def test_a_double_click_turns_about_what_is_there_and_beside_the_scene_does_nothing(opened: Page) -> None:
    place = next(
        (x, y) for y in range(200, 640, 40) for x in range(320, 960, 40) if is_something_at(opened, x, y)
    )
    opened.ask("compgsViewer.goToStart()")
    before = numbers(opened, CENTRE), numbers(opened, FORWARD)
    click_twice(opened, place)
    until(lambda: abs(numbers(opened, FORWARD) - before[1]).max() > 1e-3, "a turned camera")
    at_rest(opened)
    assert np.allclose(numbers(opened, CENTRE), before[0], atol=1e-6)
    # Turning keeps the distance to the point.
    point = before[0] + opened.ask(DISTANCE) * numbers(opened, FORWARD)
    opened.drag((640, 400), (700, 430))
    at_rest(opened)
    assert np.linalg.norm(numbers(opened, CENTRE) - point) == pytest.approx(opened.ask(DISTANCE), rel=1e-3)
    opened.ask("compgsViewer.controls.target.pose.turn([0, 1, 0], Math.PI)")
    assert not is_something_at(opened, 640, 400)


def is_something_at(page: Page, x: int, y: int) -> bool:
    page.ask(
        f"window.found = null; compgsViewer.turnAbout({x}, {y}).then((found) => (window.found = String(found)))"
    )
    return bool(until(lambda: page.ask("window.found"), "an answer") == "true")


def test_nobody_gets_through_what_they_look_at_or_out_of_sight(opened: Page) -> None:
    extent = opened.ask("compgsViewer.controls.place.extent")
    for wheel, check in ((-3000, lambda d: d >= 0.0099 * extent), (9000, lambda d: d <= 25 * extent)):
        for _ in range(4):
            opened.call("Input.dispatchMouseEvent", type="mouseWheel", x=640, y=400, deltaX=0, deltaY=wheel)
        at_rest(opened)
        assert check(opened.ask(DISTANCE))
    middle = numbers(opened, "compgsViewer.controls.place.middle")
    assert np.linalg.norm(numbers(opened, CENTRE) - middle) <= 12.001 * extent


def test_the_panel_has_field_of_view_and_background_and_escape_shuts_it(opened: Page) -> None:
    opened.ask("document.getElementById('ask').click()")
    assert not is_hidden(opened, "help")
    opened.ask("lens = document.getElementById('lens'); lens.value = 80; lens.oninput()")
    assert opened.ask("compgsViewer.fieldOfView") == pytest.approx(80, abs=1)
    opened.ask("choice = document.getElementById('background'); choice.value = 'ffffff'; choice.onchange()")
    opened.ask("compgsViewer.controls.target.pose.turn([0, 1, 0], Math.PI)")
    key(opened, "Escape", "Escape", 0.05)
    assert is_hidden(opened, "help")
    key(opened, "KeyQ", "q", 0.05)
    at_rest(opened)
    time.sleep(0.5)
    assert opened.picture()[50, 50].tolist() == [255, 255, 255]


def test_beyond_a_scene_there_is_no_black_hole(opened: Page) -> None:
    opened.ask("compgsViewer.controls.target.pose.turn([0, 1, 0], Math.PI)")
    key(opened, "KeyQ", "q", 0.05)
    at_rest(opened)
    time.sleep(0.5)
    assert opened.picture()[50, 50].tolist() == [0x2B, 0x2F, 0x36]


def test_a_picture_is_saved_as_it_is_shown(opened: Page) -> None:
    opened.ask(
        "compgsViewer.screenshot().then((blob) => blob.arrayBuffer()).then((bytes) =>"
        " (window.shot = [...new Uint8Array(bytes.slice(0, 24))]))"
    )
    head = bytes(until(lambda: opened.ask("window.shot"), "a picture"))
    assert head[:4] == b"\x89PNG"
    assert int.from_bytes(head[16:20], "big") == opened.ask("innerWidth")


def test_a_hint_is_there_at_first_and_fades_with_the_first_movement(opened: Page) -> None:
    faded = "document.getElementById('hint').classList.contains('gone')"
    assert not opened.ask(faded)
    assert "W A S D" in opened.ask("document.getElementById('hint').textContent")
    key(opened, "KeyA", "a", 0.1)
    assert until(lambda: opened.ask(faded), "a hint that fades")


@pytest.mark.parametrize(
    ("head", "title", "text"),
    [
        (
            b"ply\nformat binary_little_endian 1.0\n",
            "This is a .ply, not a .cgs file",
            "`compgs compress` makes a .cgs",
        ),
        (b"\x1f\x8b\x08\x00rest of it", "This is a .spz, not a .cgs file", "`compgs compress`"),
        (b"<!doctype html><title>log in</title>", "This is a web page, not a .cgs file", "a login"),
        (bytes(range(40)), "This is not a .cgs file", "found 00 01 02 03"),
    ],
    ids=["ply", "spz", "html", "unknown"],
)
def test_files_of_other_kinds_are_named_and_close_leads_back(
    desk: Page, tmp_path: Path, head: bytes, title: str, text: str
) -> None:
    file = tmp_path / "page.html"
    file.write_bytes(html_page(b"", ""))
    desk.open("about:blank")
    desk.open(file.as_uri())
    until(
        lambda: desk.ask("window.compgsViewer && !document.getElementById('welcome').hidden"), "the welcome"
    )
    data = base64.b64encode(head).decode()
    desk.ask(
        f"transfer = new DataTransfer(); transfer.items.add(new File([Uint8Array.from(atob('{data}'), (c) => "
        "c.charCodeAt(0))], 'a.ply')); dispatchEvent(new DragEvent('drop', { dataTransfer: transfer }))"
    )
    until(lambda: not is_hidden(desk, "error"), "an error")
    assert desk.ask("document.getElementById('error-title').textContent") == title
    assert text in desk.ask("document.getElementById('error-text').textContent")
    desk.ask("document.getElementById('close').click()")
    assert is_hidden(desk, "error") and not is_hidden(desk, "welcome")


def test_on_a_phone_fingers_turn_and_come_nearer_and_buttons_fit(
    browser: str, scene: Path, tmp_path: Path
) -> None:
    with tab(browser, tmp_path, *PHONE) as page:
        page.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
        show(page, scene)
        before = numbers(page, FORWARD)
        touch(page, [[(195, 400)], [(230, 400)], [(270, 410)]])
        assert abs(numbers(page, FORWARD) - before).max() > 1e-2
        distance = page.ask(DISTANCE)
        touch(page, [[(150, 400), (250, 400)], [(120, 400), (280, 400)], [(80, 400), (320, 400)]])
        assert page.ask(DISTANCE) < 0.8 * distance
        assert "finger" in page.ask("document.getElementById('hint').textContent")
        right, bottom = page.ask(
            "[...document.querySelectorAll('#buttons button:not([hidden])')].map((b) => b.getBoundingClientRect())"
            ".reduce(([x, y], { right, bottom }) => [Math.max(x, right), Math.max(y, bottom)], [0, 0])"
        )
        assert right <= PHONE[0] and bottom <= PHONE[1]
        assert page.ask("document.documentElement.scrollWidth") <= PHONE[0]


def touch(page: Page, steps: list[list[tuple[int, int]]]) -> None:
    """Fingers that go from place to place, and are lifted."""
    for i, fingers in enumerate(steps):
        points = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(fingers)]
        page.call("Input.dispatchTouchEvent", type="touchMove" if i else "touchStart", touchPoints=points)
        time.sleep(0.05)
    page.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
    at_rest(page)
