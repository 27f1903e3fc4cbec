"""Runs as `compgs train` leaves them, without the training: what tables are made of."""

import json
from collections.abc import Callable
from typing import Any

import pytest

from compgs.suites.jobs import Job
from compgs.suites.suite import Suite, parse_suite

TEXT = """
title = "Two scenes"
seeds = [0, 1]
survey = "Small"

[train]
steps = 30
threads = 1

[scenes.north]
path = "north_folder"
downscale = 2
published = "the north's page"

[scenes.south]
path = "south"

[methods."compgs default"]
method = "compgs"
set = { "model.width" = 16 }
vary = { "training.lmbda" = [0.001, 0.01] }

[methods.3dgs]
method = "3dgs"

[[published]]
method = "3dgs"
psnr = 23.7
bytes = 400_000_000
source = "somebody, Table 1"

[[published]]
method = "Small one"
rate = "low"
psnr = 23.1
bytes = 4_000_000
source = "somebody, Table 1"
"""


@pytest.fixture
def suite() -> Suite:
    return parse_suite(TEXT, "suite.toml")


@pytest.fixture
def finish() -> Callable[..., None]:
    """Writes what a finished run of a job would be."""

    def finish(job: Job, psnr: float, size: int, seconds: float = 5.0) -> None:
        job.folder.mkdir(parents=True, exist_ok=True)
        results: dict[str, Any] = {
            "schema": "compgs results 1", "scene": job.scene, "psnr": psnr, "ssim": psnr / 40, "bytes": size,
            "components": {"all": size}, "width": 48, "height": 36, "decode_seconds": seconds / 100,
            "render_seconds": seconds / 200, "coupled_primitives": 1000,
        }  # fmt: skip
        (job.folder / "results.json").write_text(json.dumps(results))
        (job.folder / "job.json").write_text(json.dumps(job.asked))
        (job.folder / "training.json").write_text(
            json.dumps({"seconds": seconds, "resumed": False, "encode_seconds": seconds / 50})
        )

    return finish
