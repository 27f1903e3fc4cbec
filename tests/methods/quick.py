"""Runs of a second that go through growth, for every method that builds on plain 3DGS."""

from dataclasses import replace
from typing import Any

from compgs.methods import settings_of

STEPS = 40


def quick(method: str, preset: str = "default", *, steps: int = STEPS, **sections: dict[str, Any]) -> Any:
    """Settings of a short run that grows; `sections`: what is to be changed in them, by name."""
    config = settings_of(method, preset)
    growth = {"densify_every": 0.2, "densify_stop": 0.9, "gradient_threshold": 1e-5}
    sections = {**sections, "splats": {**growth, **sections.get("splats", {})}}
    sections["training"] = {"steps": steps, "seed": 3, **sections.get("training", {})}
    return replace(config, **{name: replace(getattr(config, name), **v) for name, v in sections.items()})
