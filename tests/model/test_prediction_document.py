"""docs/bitstream_prediction.md and the code say the same: networks, tensors, and the primitive worked out by hand."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest

from compgs.cameras import Camera
from compgs.model import HeadDimensions, HybridModel, PrimitiveArrays
from compgs.model.head_weights import HeadWeights, weight_shapes

ROOT = Path(__file__).parents[2]
DOCUMENT = (ROOT / "docs" / "bitstream_prediction.md").read_text(encoding="utf-8")
sys.path.append(str(ROOT / "tools"))
from plain_prediction import Content, network_steps, primitives, view_embedding  # noqa: E402

Table = dict[str, np.ndarray]
EXAMPLE = DOCUMENT.split("## One primitive by hand")[1]
SHOWN = 5.1e-10  # half of the last digit that the document shows


def table(head: str) -> Table:
    """The numbers of the table with this heading; matrices by rows, a row of a table of one row as a vector."""
    body = re.search(rf"^\| {head} \|.*\n\|---\|---\|\n((?:\|.*\n)+)", EXAMPLE, re.MULTILINE)
    assert body
    found = {}
    for name, values in re.findall(r"^\| `(.+?)` \| (.*) \|$", body[1], re.MULTILINE):
        rows = [[float(v) for v in row.split(",")] for row in values.split(" / ")]
        found[name] = np.array(rows if len(rows) > 1 else rows[0])
    return found


TENSORS, INPUTS, STEPS = table("Tensor"), table("Input"), table("Step")


def example() -> Content:
    return Content(
        heads=TENSORS,
        layout="paired",
        coordinates=INPUTS["coordinates"][None].astype(int),
        mask=np.array([[False, True]]),
        references=INPUTS["f"][None],
        log_scales=INPUTS["s"][None],
        residuals=np.zeros((1, 1)),
        voxel_size=float(INPUTS["voxel_size"][0]),
        view_distance_scale=float(INPUTS["view_distance_scale"][0]),
        world_offset=tuple(INPUTS["world_offset"]),
    )


def test_the_document_names_the_networks_of_every_layout() -> None:
    rows = re.findall(
        r"^\| \d (separate|paired|shallow) \| `(\w+)` \| ([fvg, ]+) \| ([DG4 +]+) \| (\d+) \| (\d+) \|$",
        DOCUMENT,
        re.MULTILINE,
    )
    d, g, h = 5, 3, 7
    found: dict[str, dict[str, tuple[int, ...]]] = {"separate": {}, "paired": {}, "shallow": {}}
    for layout, network, inputs, size, outputs, blocks in rows:
        count = sum({"D": d, "4": 4, "G": g}[part] for part in size.split(" + "))
        assert count == sum({"f": d, "v": 4, "g": g}[part] for part in inputs.split(", "))
        sizes = {"I": count, "H": h, "O": int(outputs)}
        for name, shape in re.findall(r"^\| `NAME\.(\S+)` \| \[(.*?)\]", DOCUMENT, re.MULTILINE):
            for b in range(int(blocks) if ".b." in name else 1):
                full = f"{network}.{name}".replace(".b.", f".{b}.")
                found[layout][full] = tuple(sizes[side] for side in shape.split(", "))
    for layout, tensors in found.items():
        assert tensors == weight_shapes(layout, HeadDimensions(d, g, h))


def test_every_number_of_the_worked_example_is_right() -> None:
    content = example()
    p = next(iter(primitives(content, tuple(INPUTS["camera_center"]))))
    local = INPUTS["camera_center"] - INPUTS["world_offset"]
    v = view_embedding(p.position, local, content.view_distance_scale)
    g = TENSORS["residuals"][1]
    found = {"position": p.position, "reach": p.reach, "size": p.size, "v": v, "g": g}
    for network, parts in (("geometry", (INPUTS["f"], g)), ("appearance", (INPUTS["f"], v, g))):
        steps = network_steps(TENSORS, network, np.concatenate(parts))
        found |= {f"{network}: {name}": values for name, values in steps}
    found |= {name: getattr(p, name) for name in ("mean", "scales", "quaternion", "opacity", "color")}
    assert list(STEPS) == list(found)
    for name, values in found.items():
        assert STEPS[name] == pytest.approx(np.atleast_1d(values), abs=SHOWN, rel=0), name


def test_the_worked_example_is_what_the_package_predicts() -> None:
    tensors = {name: tensor.astype(np.float32) for name, tensor in TENSORS.items() if name != "residuals"}
    heads = HeadWeights("paired", HeadDimensions(2, 1, 2), tensors)

    def row(name: str) -> np.ndarray:
        return INPUTS[name].astype(np.float32)[None]

    voxel_size = float(INPUTS["voxel_size"][0])
    anchor = PrimitiveArrays(
        positions=row("coordinates") * np.float32(voxel_size),
        log_scales=row("s"),
        references=row("f"),
        residuals=TENSORS["residuals"].astype(np.float32)[1:],
        anchor_index=np.zeros(1, np.int64),
        voxel_size=voxel_size,
    )
    model = HybridModel(anchor, heads, float(INPUTS["view_distance_scale"][0]), (0.0, 0.0, 0.0))
    pose = np.eye(4)
    pose[:3, 3] = INPUTS["world_offset"] - INPUTS["camera_center"]
    found = model.gaussians(Camera(pose, 50, 50, 32, 32, 64, 64))
    for name in ("means", "scales", "quaternions", "opacities", "colors"):
        shown = STEPS[{"opacities": "opacity", "scales": "scales"}.get(name, name.removesuffix("s"))]
        assert np.atleast_1d(getattr(found, name)[0]) == pytest.approx(shown, abs=2e-6)
