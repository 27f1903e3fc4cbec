"""Placeholder until the branch with viewpoints is merged."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Viewpoints:
    """Where to look from."""


def encode_viewpoints(viewpoints: Viewpoints) -> bytes:
    raise NotImplementedError


def decode_viewpoints(data: bytes, section: str) -> Viewpoints:
    raise NotImplementedError
