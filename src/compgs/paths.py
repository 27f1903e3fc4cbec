"""What is given to a function where it expects a path: other things are refused with the way from them to a file."""

import os
from pathlib import Path

from compgs.errors import ConfigError


def as_path(given: object, name: str, kind: str = "file") -> Path:
    """The path of a file, or of another `kind`, that the argument `name` of a function is. Raises ConfigError for what
    is none.
    """
    if isinstance(given, (str, os.PathLike)):
        return Path(given)
    found = f"{name}: expected the path of a {kind}, found {type(given).__name__}"
    if hasattr(given, "as_hybrid_model"):
        raise ConfigError(f"{found}; compgs.encode(model, 'scene.cgs') writes the file of a trained model")
    if hasattr(given, "gaussians"):
        raise ConfigError(f"{found}; give the path that it was opened from")
    raise ConfigError(found)
