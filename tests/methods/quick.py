"""Runs of a second that go through growth, for every method that builds on plain 3DGS."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from compgs.config import TrainingConfig
from compgs.methods import settings_of, train, write
from compgs.scene.views import Scene

STEPS = 40


def quick(method: str, preset: str = "default", *, steps: int = STEPS, **sections: dict[str, Any]) -> Any:
    """Settings of a short run that grows; `sections`: what is to be changed in them, by name."""
    config = settings_of(method, preset)
    growth = {"densify_every": 0.2, "densify_stop": 0.9, "gradient_threshold": 1e-5}
    sections = {**sections, "splats": {**growth, **sections.get("splats", {})}}
    changed = {name: replace(getattr(config, name), **values) for name, values in sections.items()}
    return replace(config, training=TrainingConfig(steps=steps, seed=3), **changed)


def check_continues_exactly(method: str, config: Any, scene: Scene, stop: int, folder: Path) -> None:
    """A run that was stopped after so many steps, and one that was not, give the same file."""

    def stopped(status: Any) -> None:
        if status.step == stop:
            raise KeyboardInterrupt

    def written(model: Any, name: str) -> bytes:
        write(model, folder / name, method=method, config=config)
        return (folder / name).read_bytes()

    run = folder / "run"
    whole = written(train(scene, config, method=method, device="cpu"), "a")
    with pytest.raises(KeyboardInterrupt):
        train(scene, config, method=method, device="cpu", output=run, on_progress=stopped)
    for _ in range(2):  # a finished run gives the same again
        again = train(scene, config, method=method, device="cpu", output=run, resume=True)
        assert written(again, "b") == whole
