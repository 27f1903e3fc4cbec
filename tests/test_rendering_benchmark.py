"""The benchmark of rendering measures what this program does now."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARK = Path(__file__).resolve().parents[1] / "benchmarks" / "rendering.py"


@pytest.mark.slow
def test_a_small_scene_is_decoded_and_rendered_and_its_parts_are_those_of_a_frame(tmp_path: Path) -> None:
    found = tmp_path / "found.json"
    command = [sys.executable, str(BENCHMARK), "--anchors", "500", "--width", "64", "--height", "48"]
    command += ["--frames", "3", "--threads", "1", "--output", str(found)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (results,) = json.loads(found.read_text())
    decoded, rendered = results["decode"], results["render"]
    assert 450 < rendered["anchors"] <= 500 and rendered["visible"] > 0.5
    # At least four bytes of each anchor's 3 + 6 + 32 values, and of each primitive's index.
    assert decoded["model_mb"] == rendered["model_mb"]
    assert decoded["model_mb"] > 4 * (rendered["anchors"] * (3 + 6 + 32) + rendered["coupled"]) / 1e6
    assert set(rendered["parts_ms"]) >= {"networks", "projection", "blending"}
    assert sum(rendered["parts_ms"].values()) < 3 * rendered["frame_ms"]
