"""Folders of runs, as trainings and evaluations leave them, with numbers made up by the tests."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from compgs.config import Config

Maker = Callable[..., Path]
WIDTH, HEIGHT = 48, 32
PHOTOGRAPHS = {"bright.jpg": 200, "dark.jpg": 40}  # levels of gray


@pytest.fixture
def make_run(tmp_path: Path) -> Maker:
    """`make_run(name, bytes=..., psnr=(..., ...))`: a folder tmp_path/runs/name."""

    def make(
        name: str,
        *,
        scene: str = "garden",
        method: str | None = "compgs",  # None: an evaluation, without settings
        preset: str = "default",
        lmbda: float = 0.001,
        seed: int = 0,
        bytes: int = 1000,
        psnr: tuple[float | None, ...] = (30.0, 20.0),
        ssim: float = 0.9,
        settings: dict[str, Any] | None = None,  # section.key of other settings
        results: dict[str, Any] | None = None,
        curve: bool = True,
        pictures: bool = True,
    ) -> Path:
        folder = tmp_path / "runs" / name
        folder.mkdir(parents=True)
        known = [value for value in psnr if value is not None]
        entries = [
            {"name": view, "file": f"{i:05d}.png", "psnr": value, "ssim": ssim, "lpips": None}
            for i, (view, value) in enumerate(zip(PHOTOGRAPHS, psnr, strict=False))
        ]
        content = {
            "schema": "compgs results 1", "scene": scene, "file": f"{name}.cgs", "width": WIDTH, "height": HEIGHT,
            "psnr": sum(known) / len(known) if known else None, "ssim": ssim, "lpips": None, "bytes": bytes,
            "components": {"positions": bytes // 4, "embeddings": bytes - bytes // 4}, "anchors": 50,
            "coupled_primitives": 200, "splats": None, "decode_seconds": 0.05, "render_seconds": 0.02,
        }  # fmt: skip
        write(folder / "results.json", content | (results or {}))
        write(folder / "per_view.json", entries)
        if method is not None:
            values = Config().to_dict()
            chosen = {"training.lmbda": lmbda, "training.seed": seed, **(settings or {})}
            for key, value in chosen.items():
                section, _, field = key.partition(".")
                values.setdefault(section, {})[field] = value
            write(folder / "config.json", {"method": method, "preset": preset, "settings": values})
            steps = {"step": [10, 20, 30], "psnr": [10.0, 15.0, 16.0], "estimated_bytes": [2000, 1500, 1100]}
            training: dict[str, Any] = {"seconds": 100.0 + seed, "resumed": False, "lmbda": lmbda}
            write(folder / "training.json", training | ({"curve": steps} if curve else {}))
        for entry, level in zip(entries if pictures else [], PHOTOGRAPHS.values(), strict=False):
            for place, shown in (("gt", level), ("renders", level + 8)):
                picture = folder / "test" / place / str(entry["file"])
                picture.parent.mkdir(parents=True, exist_ok=True)
                Image.fromarray(np.full((HEIGHT, WIDTH, 3), shown, np.uint8)).save(picture)
        return folder

    return make


def write(path: Path, content: Any) -> None:
    path.write_text(json.dumps(content))
