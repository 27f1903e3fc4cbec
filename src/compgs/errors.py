"""The family of errors, by whose fault it is.

```text
CompGSError
├── SceneError                  the input data
│   ├── MissingSparseModel
│   ├── UnreadableImage
│   └── UnsupportedCamera
├── ConfigError                 the settings
│   └── MissingDependency       an extra that is not installed
│       └── Unavailable         a measure that cannot be taken here
├── OutputError                 the place to write to: exists, full, not writable
├── CheckpointError             a run that cannot be continued
├── TrainingError               a training that cannot go on (no visible primitives, not-a-number loss)
├── ReportError                 runs that hold nothing to report on
├── SplatFileError              a file of another program that does not hold splats, or not whole ones
└── BitstreamError              the .cgs file
    ├── NotACompGSFile
    ├── UnsupportedVersion
    ├── TruncatedSection
    ├── CorruptSection
    └── NotEncodable            a model that the format cannot represent (raised before anything is written)
```

Messages name the place, what was expected, what was found and, where there is one, the remedy.
"""


class CompGSError(Exception):
    """Root of everything that this package raises on purpose."""


class SceneError(CompGSError):
    """The input data is missing, damaged or contradicts itself."""


class MissingSparseModel(SceneError):
    """No camera poses were found where they were expected."""


class UnreadableImage(SceneError):
    """A view's image is missing, damaged or of the wrong size."""


class UnsupportedCamera(SceneError):
    """A camera model or pose that cannot be used as it stands."""


class ConfigError(CompGSError):
    """A setting is unknown, out of range or contradicts another."""


class MissingDependency(ConfigError):
    """An optional dependency is needed; the message has the install line."""


class Unavailable(MissingDependency):
    """A measure that cannot be taken here; the message is the reason, for reports to print."""


def install_line(extra: str) -> str:
    """How an optional dependency is installed. The project's folder is named: no package index has this package."""
    return f"pip install '.[{extra}]' in the project's folder"


class OutputError(CompGSError):
    """The output exists already, or cannot be written."""


class CheckpointError(CompGSError):
    """A run cannot be continued from what its folder holds."""


class TrainingError(CompGSError):
    """The optimization cannot go on."""


class ReportError(CompGSError):
    """Runs that are to be reported on are missing, not finished or damaged."""


class SplatFileError(CompGSError):
    """A file of splats is damaged, or not of the layout that its format asks for."""


class BitstreamError(CompGSError):
    """The file cannot be decoded, or the model cannot be encoded."""


class NotACompGSFile(BitstreamError):
    """The file does not begin as a .cgs file does."""


class UnsupportedVersion(BitstreamError):
    """The file was written by a version of the format that this decoder does not know."""


class TruncatedSection(BitstreamError):
    """The file ends before a section does."""


class CorruptSection(BitstreamError):
    """A section's checksum, counts or content contradict each other or the limits of the format."""


class NotEncodable(BitstreamError):
    """The model holds something that the format cannot represent; nothing was written."""
