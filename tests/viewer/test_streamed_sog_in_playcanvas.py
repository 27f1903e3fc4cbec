"""PlayCanvas's own loader opens the levels that `compgs export` writes: its picture of each is the renderer's."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import compgs
from compgs.cameras import Camera
from compgs.codec.reader import read_content
from compgs.codec.writer import write_content
from compgs.formats import sog_streamed, sog_streamed_writer
from compgs.metrics import psnr, to_8bit
from compgs.model.splats import SplatModel
from compgs.ordering.order import canonical_order, level_counts
from compgs.render import RasterSettings

from .devtools import until
from .test_engines import HEIGHT, WIDTH, bundled, opened, page_of, project, scene_file, served

__all__ = ["project"]  # a fixture
LEAST_DB = 35.0
PAGE = """import { Application, Asset, Color, Entity, Mat4 } from "playcanvas";
import { drawAsTrained } from "compgs/playcanvas";
const { pose, fov, background, level } = await (await fetch("camera.json")).json();
const app = new Application(document.querySelector("canvas"));
app.start();
drawAsTrained(app);
const camera = new Entity("camera");
camera.addComponent("camera", { clearColor: new Color(...background), fov, nearClip: 0.01, farClip: 1000 });
const matrix = new Mat4().set(pose);
camera.setPosition(matrix.getTranslation());
camera.setEulerAngles(matrix.getEulerAngles());
app.root.addChild(camera);
const asset = new Asset("levels", "gsplat", { url: "levels/lod-meta.json" });
asset.on("error", (error) => console.error(error));
app.assets.add(asset);
app.assets.load(asset);
asset.ready(() => {
  const splats = new Entity("splats");
  splats.addComponent("gsplat", { asset, unified: true });
  splats.gsplat.lodRangeMin = splats.gsplat.lodRangeMax = level;
  app.root.addChild(splats);
  window.isThere = true;
});
"""


@pytest.fixture(scope="module")
def levels(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A file that goes from coarse to fine, and its levels in several leaves and parts."""
    folder = tmp_path_factory.mktemp("levels")
    content = read_content(scene_file("paired"))
    counts = level_counts(content.coordinates[canonical_order(content.coordinates)])
    found = [i for i, count in enumerate(counts) if i == 0 or count > counts[i - 1]]
    found[-1] = len(counts) - 1
    source = folder / "scene.cgs"
    source.write_bytes(write_content(content, levels=found))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sog_streamed_writer, "MOST_IN_LEAF", 300)
        patch.setattr(sog_streamed_writer, "MOST_IN_PART", 700)
        exported = compgs.export(source, folder / "levels" / sog_streamed.NAME, refine=10, progress=False)
    assert exported.bytes == sum(f.stat().st_size for f in (folder / "levels").rglob("*") if f.is_file())
    return source, folder / "levels" / sog_streamed.NAME


def described(camera: Camera, background: tuple[float, ...], level: int) -> bytes:
    """As PlayCanvas has cameras: columns of the rotation from camera to world, y up, looking along -z."""
    right, down, forward = camera.rotation
    columns = (right, -down, -forward, camera.center)
    pose = [float(x) for column in columns for x in (*column, 0.0)]
    pose[15] = 1.0
    fov = math.degrees(2 * math.atan(camera.height / (2 * camera.fy)))
    return json.dumps({"pose": pose, "fov": fov, "background": background, "level": level}).encode()


@pytest.mark.slow
@pytest.mark.parametrize("which", ["finest", "coarsest"])
def test_playcanvas_draws_what_the_renderer_draws_of_a_level(
    which: str, levels: tuple[Path, Path], node: str, browser: str, project: Path, tmp_path: Path
) -> None:
    source, path = levels
    scene = compgs.decode(source)
    level = 0 if which == "finest" else sog_streamed.read_meta(path).levels - 1
    camera = replace(scene.viewpoints[0], width=WIDTH, height=HEIGHT).moved(scene.world_offset)
    splats = SplatModel(sog_streamed.read(path, level), scene.background)
    expected = to_8bit(compgs.render(splats, camera, RasterSettings(background=scene.background)).image)
    assert expected.std() > 10
    entry = project / "levels.js"
    entry.write_text(PAGE)
    files = {
        f"/levels/{f.relative_to(path.parent)}": f.read_bytes() for f in path.parent.rglob("*") if f.is_file()
    }
    files["/camera.json"] = described(camera, scene.background, level)
    with (
        served(page_of(bundled(node, project, entry)) | files) as site,
        opened(browser, tmp_path / "browser", site, "/index.html") as page,
    ):
        until(lambda: page.ask("window.isThere"), "the levels", 180)
        best = [0.0]

        def is_alike() -> bool:
            best[0] = max(best[0], psnr(np.ascontiguousarray(page.picture()), expected))
            return best[0] >= LEAST_DB

        try:
            until(is_alike, "the picture", 180)
        except AssertionError:
            said = page.ask("said.join()")
            raise AssertionError(f"{best[0]:.1f} dB at best; the page says: {said}") from None
        asked = [address for address in page.requests if address.endswith("meta.json")]
        chosen = {f"/{level}_" in address for address in asked if "lod-meta" not in address}
        assert chosen == {True}  # no part of another level was loaded


def test_pictures_of_the_finest_level_are_those_of_the_scene(levels: tuple[Path, Path]) -> None:
    source, path = levels
    scene = compgs.decode(source)
    values = {}
    for level in range(sog_streamed.read_meta(path).levels):
        model = SplatModel(sog_streamed.read(path, level), scene.background).at(scene.world_offset)
        pictures = [to_8bit(compgs.render(m, scene.viewpoints[0]).image) for m in (scene, model)]
        values[level] = psnr(*pictures)
    assert values[0] > 30
    assert values[0] > values[max(values)]  # coarser is farther from it
