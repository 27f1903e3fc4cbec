"""Which level of a scene that has several."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import arg


@dataclass(frozen=True, kw_only=True)
class LevelOption:
    """A level of detail."""

    level: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 0, the finest)")] = None
    """Level that is opened of a lod-meta.json, which is a streamed .sog of several levels of detail."""
