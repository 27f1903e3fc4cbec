"""What somebody does who has received a file: with the installation without extras, every command must work.

    python tools/check_light.py FILE FOLDER

FILE is a .cgs with viewpoints; what is written goes to FOLDER, which must be new. Prints how long it took.
`make bounds` runs it at the lowest versions; the tests run it where torch, scipy and safetensors are hidden.
"""

import shutil
import sys
import time
from pathlib import Path

import numpy as np


def commands(file: str, folder: Path) -> list[list[str]]:
    """Command lines, in an order in which they work."""
    small = ["--degree", "1", "--refine", "3"]
    return [
        ["info", file],
        ["decode", file, "-o", str(folder / "arrays")],
        ["render", file, "--frames", "2", "--width", "48", "--height", "32", "-o", str(folder / "frames")],
        ["encode", file, "-o", str(folder / "smaller.cgs"), "--drop", "0.2", "--coarser", "2"],
        ["export", file, str(folder / "a.html")],
        *(["export", file, str(folder / f"a.{kind}"), *small] for kind in ("ply", "spz", "sog", "glb")),
        ["export", str(folder / "a.ply"), str(folder / "b.spz"), "--max-splats", "50", "--refine", "3"],
        ["compare", file, str(folder / "a.ply"), "-o", str(folder / "compared")],
    ]


def check_python(file: str) -> None:
    """The same from Python: arrays come back."""
    import compgs
    from compgs import metrics
    from compgs.viewer.gallery import gallery_server

    model = compgs.decode(file)
    image = compgs.render(model, model.viewpoints[0]).image
    assert isinstance(image, np.ndarray) and image.dtype == np.float32 and image.std() > 0
    assert type(compgs.open_scene(file)) is type(model)
    eight = metrics.to_8bit(image)
    assert metrics.ssim(eight, eight) > 0.9999 and metrics.psnr(eight, eight) == float("inf")
    gallery_server(Path(file).parent, "127.0.0.1", 0).server_close()


def main() -> None:
    source, folder = sys.argv[1:]
    start = time.process_time()
    Path(folder).mkdir(parents=True)
    file = shutil.copy(source, folder)
    from compgs.cli.main import main as run

    for command in commands(file, Path(folder)):
        code = run(command)
        assert code == 0, (code, command)
    check_python(file)
    loaded = {name.partition(".")[0] for name in sys.modules} & {"torch", "scipy", "safetensors"}
    assert not loaded, f"loaded: {loaded}"
    print(
        f"all of it works: {time.process_time() - start:.0f} s of processor time, with compiling what was not yet"
    )


if __name__ == "__main__":
    main()
