"""The first training on a machine, whose kernels are compiled for it, is as good as any later one."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import compgs

PROGRAM = """
import sys
from pathlib import Path
import compgs
from compgs.cli.settings import with_settings
from compgs.config import load_config
from compgs.training.splats.phases import train_splats
from compgs.formats.ply import write_ply

scene = compgs.load_scene(sys.argv[1])
steps = ("training.steps=60", "training.phases=0.05,0.2,0.8,0.8,0.9", "control.start=0.2", "control.minimum_views=2")
model = compgs.train(scene, with_settings(load_config("quick"), steps))
# Not the file: coding it takes other kernels, of integers, which have one result however they are compiled.
Path(sys.argv[2] + ".model").write_bytes(b"".join(x.numpy().tobytes() for x in model.state_dict().values()))
splats = train_splats(scene, with_settings(load_config("quick"), ("training.steps=60",))).splats
write_ply(splats, sys.argv[2] + ".ply")
from compgs.render.tiles import blend_backward
print(sum(blend_backward.stats.cache_hits.values()))
"""


@pytest.mark.slow
def test_freshly_compiled_and_cached_kernels_train_the_same_models(
    scene_folder: Path, tmp_path: Path
) -> None:
    """numba optimizes a parallel kernel once to run it and once more for its cache."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
    hits = []
    for name in ("compiled", "cached"):
        command = [sys.executable, "-c", PROGRAM, str(scene_folder), str(tmp_path / name)]
        done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
        hits.append(int(done.stdout.split()[-1]))
    assert hits == [0, 1], "the second process was to find the first one's kernels"
    for kind in (".model", ".ply"):
        compiled, cached = (
            (tmp_path / name).with_suffix(kind).read_bytes() for name in ("compiled", "cached")
        )
        assert compiled == cached, kind


def test_no_kernel_leaves_the_order_of_its_additions_to_the_compiler() -> None:
    """But for the sums that say so (`vector_sums`)."""
    for file in sorted(Path(compgs.__file__).parent.rglob("*.py")):
        if file.name != "vector_sums.py":
            source = file.read_text(encoding="utf-8")
            assert not re.search(r"[\"']reassoc[\"']|fastmath=True", source), file
