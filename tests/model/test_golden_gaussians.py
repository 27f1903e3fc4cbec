"""Golden files: what a camera sees of each, within the tolerance that docs/bitstream_prediction.md promises."""

import json
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from compgs.codec.content import Role
from compgs.codec.decoder import decode
from compgs.codec.reader import read_latents
from compgs.codec.writer import write_content
from compgs.gaussians import Gaussians
from compgs.metrics import to_8bit
from compgs.render import render

ROOT = Path(__file__).parents[2]
GOLDEN = ROOT / "tests" / "golden"
PINNED_FILE = GOLDEN / "gaussians.json"
PINNED = json.loads(PINNED_FILE.read_text(encoding="utf-8")) if PINNED_FILE.exists() else {}
sys.path += [str(ROOT / "tools"), str(ROOT / "benchmarks")]
import make_golden_gaussians  # noqa: E402
from made_content import make_content, make_dimensions, paper_groups  # noqa: E402
from make_golden_files import TRAINED  # noqa: E402
from make_golden_gaussians import SHOWN, golden_gaussians, plain_content  # noqa: E402
from plain_prediction import drawn, stacked, tolerances  # noqa: E402
from prediction_precision import FIELDS, camera_at  # noqa: E402


def finite(gaussians: Gaussians) -> Gaussians:
    """Without those that a renderer leaves out, since their numbers are not finite."""
    values = {f.name: getattr(gaussians, f.name) for f in fields(gaussians)}
    kept = np.isfinite(np.concatenate([v.reshape(len(gaussians), -1) for v in values.values()], 1)).all(1)
    return Gaussians(**{name: v[kept] for name, v in values.items()})


def assert_predicted(path: Path, pinned: dict[str, Any]) -> None:
    """What the file's model predicts is what was pinned, number by number and in its sums."""
    content = plain_content(*read_latents(path.read_bytes()))
    found = finite(decode(path).gaussians(camera_at(pinned["camera_center"])))
    assert len(found) == pinned["count"] and len(pinned["first"]) == min(SHOWN, len(found))
    seen = drawn(content, tuple(pinned["camera_center"]))
    allowed = tolerances(stacked(seen))
    assert [(p.anchor, p.slot) for p in seen[:SHOWN]] == [(g["anchor"], g["slot"]) for g in pinned["first"]]
    for name, field in FIELDS.items():
        values = getattr(found, field).astype(np.float64)
        first = np.array([g[name] for g in pinned["first"]])
        assert (np.abs(values[:SHOWN] - first) <= allowed[name][:SHOWN]).all(), name
        assert (np.abs(values.sum(0) - np.array(pinned["sums"][name])) <= allowed[name].sum(0)).all(), name


@pytest.fixture
def made_file(tmp_path: Path) -> Path:
    d = make_dimensions(4, paper_groups(6, 3, 1, 2), "separate", 8)
    content = make_content(90, 4, d)
    path = tmp_path / "made.cgs"
    path.write_bytes(write_content(content))
    return path


@pytest.fixture
def pins(made_file: Path) -> dict[str, Any]:
    content = plain_content(*read_latents(made_file.read_bytes()))
    return json.loads(json.dumps(golden_gaussians(content)))


def test_every_golden_file_with_pinned_gaussians_predicts_them() -> None:
    for name, pinned in PINNED.items():
        assert_predicted(GOLDEN / f"{name}.cgs", pinned)


def test_what_is_pinned_of_a_file_is_what_its_model_predicts(made_file: Path, pins: dict[str, Any]) -> None:
    assert pins["count"] > SHOWN
    assert_predicted(made_file, pins)


def test_a_gaussian_larger_than_float32_holds_is_neither_pinned_nor_rendered(tmp_path: Path) -> None:
    d = make_dimensions(4, paper_groups(6, 3, 1, 2), "paired", 8)
    content = make_content(90, 4, d)
    content.group(Role.LOG_SCALES).symbols[3, 5] = 3000  # a size of exp(187) voxels
    assert content.mask[3].any()
    path = tmp_path / "made.cgs"
    path.write_bytes(write_content(content))
    pinned = golden_gaussians(plain_content(*read_latents(path.read_bytes())))
    assert_predicted(path, pinned)
    everything = decode(path).gaussians(camera_at(pinned["camera_center"]))
    assert pinned["count"] < len(everything)


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("where", ["first", "sums"])
def test_one_number_that_drifts_is_noticed(
    made_file: Path, pins: dict[str, Any], name: str, where: str
) -> None:
    values = pins["first"][-1] if where == "first" else pins["sums"]
    # Ten times the tolerance of a number that is not large; of the sums, ten times that of all together.
    drift = 1e-3 * (1 if where == "first" else pins["count"]) * max(1.0, np.abs(values[name]).max())
    values[name] = (np.array(values[name]) + drift).tolist()
    with pytest.raises(AssertionError, match=name):
        assert_predicted(made_file, pins)


def test_another_number_of_gaussians_is_noticed(made_file: Path, pins: dict[str, Any]) -> None:
    with pytest.raises(AssertionError):
        assert_predicted(made_file, pins | {"count": pins["count"] + 1})


def test_a_file_with_an_opacity_near_the_threshold_from_everywhere_is_not_pinned(
    made_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(make_golden_gaussians, "MARGIN", 2.0)  # no opacity is farther away
    with pytest.raises(ValueError, match="DIRECTIONS"):
        golden_gaussians(plain_content(*read_latents(made_file.read_bytes())))


@pytest.mark.parametrize("name", TRAINED)
def test_a_trained_file_looks_as_it_did_when_its_picture_was_pinned(name: str) -> None:
    """Made by plain torch in float64: here and there a splat is on the other side of the cutoff in float32."""
    model = decode(GOLDEN / f"{name}.cgs")
    found = to_8bit(render(model, model.viewpoints[0]).image).astype(int)
    pinned = np.asarray(Image.open(GOLDEN / f"{name}.png")).astype(int)
    assert found.shape == pinned.shape and pinned.std() > 20
    difference = np.abs(found - pinned)
    assert difference.max() <= 2 and (difference > 0).mean() < 0.01
