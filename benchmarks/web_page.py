"""The page with a scene: how close its picture is to the renderer's, and how soon it is there, in headless Chromium.

    python benchmarks/web_page.py plush.cgs fox.cgs [--anchors 50000] [--times 3] [--webgpu]

Pictures are taken at the cameras that the file keeps, and compared with `compgs.render`. Seconds are from the page's
first byte until the whole scene is shown, the best of some visits; Chromium draws by software here, with WebGL2 or,
by `--webgpu`, with WebGPU. `--anchors` adds a made-up file of that many.
"""

import argparse
import shutil
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import compgs
from compgs.codec.writer import write_content
from compgs.metrics import psnr, to_8bit
from compgs.viewer import html_page

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "tests" / "viewer"))
from headless import FLAGS, WEBGPU_FLAGS, visit  # noqa: E402
from made_content import make_content, make_dimensions, paper_groups  # noqa: E402
from made_heads import make_heads  # noqa: E402


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", type=Path, nargs="*")
    parser.add_argument("--anchors", type=int, nargs="*", default=[])
    parser.add_argument("--times", type=int, default=3)
    parser.add_argument("--webgpu", action="store_true")
    options = parser.parse_args()
    flags, query = (WEBGPU_FLAGS, "?renderer=webgpu") if options.webgpu else (FLAGS, "")
    browser = shutil.which("chromium")
    if browser is None:
        raise SystemExit("no chromium on PATH")
    print("| file | bytes | page, bytes | anchors | PSNR against the renderer, mean (worst) | seconds |")
    print("|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        made = [made_file(Path(folder), count) for count in options.anchors]
        for file in [*options.files, *made]:
            data = file.read_bytes()
            page = html_page(data, file.stem)
            model = compgs.decode(file)
            best, shown = np.inf, ""
            for time in range(options.times):
                cameras = list(model.viewpoints) if time == 0 else []
                profile = Path(folder) / f"visit{time}"
                seen = visit(browser, profile, page, cameras, flags=flags, query=query)
                assert seen.error == ": ", seen.error
                best = min(best, seen.seconds)
                if cameras:
                    pairs = zip(seen.pictures, cameras, strict=True)
                    values = [
                        psnr(picture, to_8bit(compgs.render(model, camera).image))
                        for picture, camera in pairs
                    ]
                    shown = f"{np.mean(values):.1f} dB ({min(values):.1f})"
            print(
                f"| {file.name} | {len(data):,} | {len(page):,} | {model.anchors:,} | {shown} | {best:.2f} |",
                flush=True,
            )


def made_file(folder: Path, anchors: int) -> Path:
    """With the default preset's dimensions."""
    dimensions = make_dimensions(5, paper_groups(32, 0))
    content = make_content(anchors, 3, dimensions)
    path = folder / f"made_{anchors}.cgs"
    path.write_bytes(write_content(replace(content, heads=make_heads(np.random.default_rng(5), dimensions))))
    return path


if __name__ == "__main__":
    main()
