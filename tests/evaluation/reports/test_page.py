"""The line between two pictures moves by mouse, finger and keys, in a real browser; lists choose the pictures."""

import html
import json
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from compgs.evaluation.reports.page import Picture, page, slider
from compgs.evaluation.reports.pictures import data_url, webp

from .parsed_page import ParsedPage

FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--hide-scrollbars", "--force-device-scale-factor=1",
)  # fmt: skip
MAX_SECONDS = 120
COLORS = {"red": (255, 0, 0), "green": (0, 160, 0), "blue": (0, 0, 255)}
# Does what a visitor does, and writes down what is there after each step.
DRIVER = """<script>
  const stage = document.querySelector(".stage"), handle = document.querySelector(".handle");
  const seen = {}, box = stage.getBoundingClientRect();
  const look = (step) => {
    const shown = (side) => [...stage.querySelectorAll("img." + side)].map((picture) => picture.alt).join();
    const beside = [...document.querySelectorAll(".beside img")].filter((p) => getComputedStyle(p).display != "none");
    seen[step] = [getComputedStyle(stage).getPropertyValue("--cut"), handle.getAttribute("aria-valuenow"),
      shown("left"), shown("right"), beside.map((picture) => picture.alt).join(),
      Math.round(handle.getBoundingClientRect().left + 1 - box.left),
      getComputedStyle(stage.querySelector("img.left")).clipPath];
  };
  const pointer = (kind, target, share, more) => target.dispatchEvent(new PointerEvent(kind, { bubbles: true,
    cancelable: true, isPrimary: true, clientX: box.left + share * box.width, clientY: box.top + 5, ...more }));
  const key = (name) =>
    handle.dispatchEvent(new KeyboardEvent("keydown", { key: name, bubbles: true, cancelable: true }));
  const choose = (side, index) => {
    const list = document.querySelector("select." + side);
    list.selectedIndex = index;
    list.dispatchEvent(new Event("change"));
  };
  look("start");
  pointer("pointermove", window, 0.9); look("moved without a button");
  pointer("pointerdown", stage, 0.25); look("pressed");
  pointer("pointermove", window, 0.75); look("dragged");
  pointer("pointermove", window, 7); look("dragged outside");
  pointer("pointerup", window, 7); pointer("pointermove", window, 0.5); look("let go");
  pointer("pointerdown", stage, 0.1, { button: 2 }); look("other button");
  pointer("pointerdown", stage, 0.5, { pointerType: "touch" });
  pointer("pointermove", window, 0.6, { pointerType: "touch" }); look("by finger");
  pointer("pointercancel", window, 0.6, { pointerType: "touch" });
  pointer("pointermove", window, 0.2, { pointerType: "touch" }); look("scrolled away");
  key("ArrowLeft"); look("left key");
  key("PageUp"); look("page key");
  key("End"); look("end key");
  key("ArrowRight"); look("beyond the end");
  key("Home"); look("home key");
  key("x"); look("another key");
  choose("right", 2); look("blue on the right");
  choose("left", 2); look("blue on both sides");
  choose("right", 0); look("red on the right");
  const focused = document.activeElement === handle;
  document.title = JSON.stringify({ seen, focused });
</script></body>"""


def flat(color: tuple[int, int, int]) -> str:
    return data_url(webp(np.full((40, 60, 3), color, np.uint8), 60))


def made_page(caption: str = "a caption") -> bytes:
    """Three pictures; the second and third have errors."""
    red, green, blue = (flat(color) for color in COLORS.values())
    pictures = [Picture("red", red), Picture("green", green, green), Picture("blue", blue, blue)]
    return page("three <colors>", slider(pictures, 60, 40, caption))


def chromium(browser: str, folder: Path, *arguments: str) -> str:
    done = subprocess.run(
        [browser, *FLAGS, f"--user-data-dir={folder / 'browser'}", "--window-size=400,300", *arguments],
        capture_output=True,
        text=True,
        timeout=MAX_SECONDS,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def test_the_line_follows_mouse_finger_and_keys(browser: str, tmp_path: Path) -> None:
    file = tmp_path / "page.html"
    file.write_bytes(made_page().replace(b"</body>", DRIVER.encode()))
    dumped = chromium(browser, tmp_path, "--dump-dom", file.as_uri())
    title = re.search("<title>(.*?)</title>", dumped)
    assert title is not None, dumped
    found = json.loads(html.unescape(title[1]))
    seen = found["seen"]
    cuts = {step: (float(values[0].rstrip("%")), int(values[1])) for step, values in seen.items()}
    expected = {
        "start": 50, "moved without a button": 50, "pressed": 25, "dragged": 75, "dragged outside": 100,
        "let go": 100, "other button": 100, "by finger": 60, "scrolled away": 60, "left key": 58,
        "page key": 68, "end key": 100, "beyond the end": 100, "home key": 0, "another key": 0,
    }  # fmt: skip
    for step, cut in expected.items():
        assert cuts[step] == (pytest.approx(cut, abs=0.01), cut), step
        assert seen[step][2:5] == ["red", "green", "errors of green"], step
        assert seen[step][5] == pytest.approx(1.2 * cut, abs=1), step  # two pixels a pixel: 120 across
    assert seen["blue on the right"][2:5] == ["red", "blue", "errors of blue"]
    assert seen["blue on both sides"][2:5] == ["blue", "blue", "errors of blue"]
    assert seen["blue on both sides"][6] == "none"  # the whole picture is seen
    # Of a photograph there are no errors: those of the other picture are shown.
    assert seen["red on the right"][2:5] == ["blue", "red", "errors of blue"]
    assert found["focused"] and seen["home key"][6].startswith("inset(0px 100% 0px 0px)")


def test_both_pictures_are_seen_where_the_page_says(browser: str, tmp_path: Path) -> None:
    file, shot = tmp_path / "page.html", tmp_path / "shot.png"
    file.write_bytes(made_page())
    chromium(browser, tmp_path, f"--screenshot={shot}", file.as_uri())
    pixels = np.asarray(Image.open(shot).convert("RGB")).astype(int)

    def where(color: str) -> tuple[int, int, int]:
        """First and last column of a color, and how many pixels there are of it."""
        near = np.abs(pixels - COLORS[color]).max(axis=2) < 40
        columns = np.nonzero(near.any(axis=0))[0]
        return (int(columns.min()), int(columns.max()), int(near.sum())) if len(columns) else (0, 0, 0)

    left, right = where("red"), where("green")
    assert right[0] - left[1] <= 34  # the line, and its handle
    assert 40 <= left[1] - left[0] + 1 <= 60 and left[2] > 3000
    # Green is right of the line, and once more beside: its errors.
    assert right[2] > 3000 + 9000 and where("blue")[2] == 0


def test_a_caption_is_text_and_the_page_is_alone() -> None:
    parsed = ParsedPage(made_page("<script>alert(1)</script>"))
    assert parsed.tags.count("script") == 1 and "<script>alert(1)</script>" in parsed.text
    assert parsed.asks_nothing_of_the_network()
    assert "colors" not in parsed.tags


def test_names_that_are_no_text_do_not_stop_a_page() -> None:
    assert "caption ?" in made_page("caption \udce9").decode()
