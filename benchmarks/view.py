"""What moving pictures of the live viewer cost: frames a second that two free cores give, and the size they settle at.

    python benchmarks/view.py [--file scene.cgs | --anchors 50000] [--width 480 --height 360] [--frames 60]

Without a file, a made-up scene: anchors on surfaces, four of five coupled primitives kept. A camera goes around it as
a visitor's would; each picture goes through the viewer's own loop (culling, prediction, rasterization, 8 bits) and is
encoded as the page gets it. Wall time counts only on a machine that does nothing else: processor seconds of a picture
are printed beside it, and what two cores that share them evenly would need.
"""

import argparse
import io
import json
import tempfile
import time
from pathlib import Path

import compgs  # noqa: F401  # before torch: its threads must not spin


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--file", type=Path)
    parser.add_argument("--anchors", type=int, default=50_000)
    parser.add_argument("--width", type=int, default=480)
    parser.add_argument("--height", type=int, default=360)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if options.file is None:
            import rendering

            options.file = Path(folder) / "made.cgs"
            rendering.make(options)
        print(json.dumps(measured(options), indent=2))


def measured(options: argparse.Namespace) -> dict[str, object]:
    import numba
    from PIL import Image

    from compgs.scene.generated import camera_path
    from compgs.viewer.live import FULL_QUALITY, MOVING_QUALITY
    from compgs.viewer.shown import FileShown
    from compgs.viewer.stage import OwnThread
    from compgs.viewer.visitor import Lens, Look, Picture, Visitor, lens_of

    shown = FileShown(options.file, "cpu")
    way = camera_path(max(8, options.frames), options.width, options.height)
    if shown.whole.viewpoints:
        from compgs.evaluation.tour import tour

        cameras = shown.whole.viewpoints
        way = [c for _, c in tour(cameras, frames=len(way), width=options.width, height=options.height)]

    class Page:
        """A camera that goes on with each picture, and an encoder."""

        at = 0

        def lens(self) -> Lens:
            return lens_of(way[self.at % len(way)])

        def show(self, picture: Picture) -> None:
            quality = FULL_QUALITY if picture.full else MOVING_QUALITY
            Image.fromarray(picture.image).save(io.BytesIO(), format="jpeg", quality=quality)
            self.at += 1

        def fail(self, message: str) -> None:
            raise SystemExit(message)

    page = Page()
    stage = OwnThread(lambda: numba.set_num_threads(options.threads))
    visitor = Visitor(page, shown, stage, Look(len(shown.levels) - 1, shown.background))

    def pictures(count: int, *, moving: bool) -> tuple[float, float, float]:
        """Seconds and processor seconds of a picture, and the share of the sides at the end."""
        start, processor = time.perf_counter(), time.process_time()
        for _ in range(count):
            visitor.changed(moving=moving)
            page.show(stage.run(visitor.draw))
        spent = time.perf_counter() - start, time.process_time() - processor
        return spent[0] / count, spent[1] / count, (visitor.moving if moving else visitor.resting).share

    pictures(4, moving=False)  # kernels are loaded
    rest = pictures(options.frames, moving=False)
    pictures(20, moving=True)  # the size settles
    move = pictures(options.frames, moving=True)
    stage.close()
    found = {name: row(*values, options.threads) for name, values in (("at rest", rest), ("moving", move))}
    return {**shown.whole.counts, "width": options.width, "height": options.height, **found}


def row(seconds: float, processor: float, share: float, threads: int) -> dict[str, float]:
    return {
        "share of the sides": round(share, 3),
        "ms": round(1e3 * seconds, 1),
        "processor ms": round(1e3 * processor, 1),
        "frames a second, measured": round(1 / seconds, 1),
        "frames a second, processor time shared evenly": round(threads / processor, 1),
    }


if __name__ == "__main__":
    main()
