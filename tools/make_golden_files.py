"""Writes tests/golden: small files of this version of the format, and hashes of what they decode to.

    python tools/make_golden_files.py

Run it when the version of the format rises, and only then: golden files of a version decode for ever.
"""

import hashlib
import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from compgs.codec.content import Dimensions, FileContent, Latents
from compgs.codec.format import MAX_SYMBOL
from compgs.codec.reader import read_latents
from compgs.codec.writer import write_content

ROOT = Path(__file__).parent.parent
GOLDEN = ROOT / "tests" / "golden"
sys.path.append(str(ROOT / "benchmarks"))
from made_content import make_content  # noqa: E402

SYMBOLS = ("coordinates", "mask", "reference_hyper", "reference", "covariance", "residual_hyper", "residual")
LATENTS = ("reference", "covariance", "residual")


def contents() -> dict[str, FileContent]:
    """By name: the smallest sensible file, one with the default dimensions, one with everything unusual."""
    tiny = make_content(3, 1, Dimensions(2, 2, 2, 1, 1, "paired", 2), kept=0.7)
    default = make_content(150, 2)
    odd = make_content(70, 3, Dimensions(5, 7, 3, 2, 3, "separate", 8), kept=0.4, hidden=9)
    for name in ("reference_hyper", "reference", "covariance", "residual_hyper"):
        getattr(odd, name)[::9] *= 1000
        getattr(odd, name)[4, -1] = -MAX_SYMBOL
    odd.residual[odd.mask] += 300
    return {
        "tiny": tiny,
        "default": default,
        "odd": replace(odd, metadata={"note": "Ä", "creator": "made up"}),
    }


def hashes(content: FileContent, latents: Latents) -> dict[str, str]:
    """SHA-256 of each array as little-endian 32-bit integers (the mask as bytes), in canonical order."""
    arrays = {name: getattr(content, name) for name in SYMBOLS}
    arrays |= {f"{name}_latents": getattr(latents, name) for name in LATENTS}
    return {
        name: hashlib.sha256(array.astype("u1" if array.dtype == np.bool_ else "<i4").tobytes()).hexdigest()
        for name, array in arrays.items()
    }


def main() -> None:
    GOLDEN.mkdir(parents=True, exist_ok=True)
    pinned = {}
    for name, content in contents().items():
        data = write_content(content)
        _write(GOLDEN / f"{name}.cgs", data)
        pinned[name] = {"file": hashlib.sha256(data).hexdigest(), **hashes(*read_latents(data))}
        print(f"{name}.cgs: {len(data)} bytes")
    _write(GOLDEN / "hashes.json", (json.dumps(pinned, indent=2) + "\n").encode())


def _write(path: Path, data: bytes) -> None:
    temporary = path.with_name(f".{path.name}.partial")
    temporary.write_bytes(data)
    os.replace(temporary, path)


if __name__ == "__main__":
    main()
