"""What a suite is: scenes, methods with their rates, seeds. A TOML file, or the name of one that is shipped.

title = "Two captures"
seeds = [0, 1]

[train]                                   # options of every run, as on the command line
steps = 1500
threads = 1

[scenes.plush]
path = "plush_480"                        # inside the data's folder
downscale = 2
hold_out = "sector"                       # or "every"; left out, what the capture names, else every test_every-th
published = "where to get it"             # said where it is missing

[methods."compgs default"]                # the name in tables
method = "compgs"
preset = "default"
vary = { "training.lmbda" = [0.001, 0.01] }

[methods.3dgs]
method = "3dgs"

[[published]]                             # rows of others, marked as such
method = "CompGS (paper)"
rate = "lambda 0.001"
psnr = 23.70
ssim = 0.84
lpips_3dgs = 0.21                         # images in [0, 1], as nearly everybody publishes; lpips: in [-1, 1]
bytes = 10_070_163
source = "Liu et al. 2024, Table 1"
"""

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from importlib import resources
from pathlib import Path
from typing import Any

from compgs.errors import ConfigError
from compgs.methods import METHODS

NAME = re.compile(r"[\w .+-]+")  # of scenes and methods: they become folders
SHIPPED = tuple(
    sorted(
        file.name.removesuffix(".toml")
        for file in (resources.files("compgs.suites") / "shipped").iterdir()
        if file.name.endswith(".toml")
    )
)

HOLD_OUT = ("auto", "every", "sector")

SetValue = bool | int | float | str | list[Any]


@dataclass(frozen=True)
class SceneEntry:
    """A scene, and how it is read."""

    name: str
    path: str  # inside the data's folder
    downscale: int = 1
    images: str = "images"
    test_every: int = 8
    hold_out: str = "auto"  # auto, every or sector: as --hold-out of `compgs train`
    published: str = ""  # where it can be had


@dataclass(frozen=True)
class MethodEntry:
    """A method at its rates."""

    name: str  # in tables
    method: str  # of the registry
    preset: str = "default"
    set: Mapping[str, SetValue] = field(default_factory=dict)  # settings of all rates
    vary: Mapping[str, Sequence[SetValue]] = field(default_factory=dict)  # one setting, a run for each value

    @property
    def rates(self) -> list[dict[str, SetValue]]:
        """Settings of each run."""
        if not self.vary:
            return [{}]
        ((name, values),) = self.vary.items()
        return [{name: value} for value in values]


@dataclass(frozen=True)
class PublishedRow:
    """What somebody else has published, of the same data set, by their own evaluation."""

    method: str
    source: str
    rate: str = ""
    psnr: float | None = None
    ssim: float | None = None
    lpips: float | None = None  # images given in [-1, 1]
    lpips_3dgs: float | None = None  # images given in [0, 1], as the release of 3DGS does
    bytes: float | None = None


@dataclass(frozen=True)
class Suite:
    """What is to be run."""

    title: str
    scenes: tuple[SceneEntry, ...]
    methods: tuple[MethodEntry, ...]
    seeds: tuple[int, ...] = (0,)
    train: Mapping[str, SetValue] = field(default_factory=dict)  # options of `compgs train`, for every run
    published: tuple[PublishedRow, ...] = ()
    survey: str = ""  # the data set's name in the 3DGS compression survey, if it is one of its


# Options of `compgs train` that a suite may give to every run; all else is a setting.
TRAIN_OPTIONS = ("steps", "threads", "device", "lpips", "lpips_weights", "flip")


def load_suite(name: str | Path) -> Suite:
    """The suite in a file, or the shipped one of that name. Raises ConfigError that says where it is wrong."""
    if str(name) in SHIPPED:
        text = (resources.files("compgs.suites") / "shipped" / f"{name}.toml").read_text(encoding="utf-8")
        return parse_suite(text, str(name))
    path = Path(name)
    if not path.is_file():
        raise ConfigError(
            f"{name}: there is no such suite; expected a TOML file, or one of {', '.join(SHIPPED)}"
        )
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from error
    return parse_suite(text, str(path))


def parse_suite(text: str, place: str) -> Suite:
    """Raises ConfigError."""
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{place}: not TOML ({error})") from error
    known = {"title", "seeds", "train", "scenes", "methods", "published", "survey"}
    _only(content, known, place)
    scenes = tuple(
        _entry(SceneEntry, n, v, f"{place}, scenes.{n}") for n, v in _tables(content, "scenes", place)
    )
    methods = tuple(
        _entry(MethodEntry, n, v, f"{place}, methods.{n}") for n, v in _tables(content, "methods", place)
    )
    for method in methods:
        _check_method(method, place)
    train = content.get("train", {})
    _only(train, set(TRAIN_OPTIONS), f"{place}, train")
    seeds = content.get("seeds", [0])
    if not (isinstance(seeds, list) and seeds and all(type(seed) is int and seed >= 0 for seed in seeds)):
        raise ConfigError(f"{place}, seeds: expected a list of whole numbers, found {seeds!r}")
    rows = content.get("published", [])
    published = tuple(_row(row, f"{place}, published {i + 1}") for i, row in enumerate(rows))
    return Suite(
        title=str(content.get("title", place)),
        scenes=scenes,
        methods=methods,
        seeds=tuple(seeds),
        train=train,
        published=published,
        survey=str(content.get("survey", "")),
    )


def _tables(content: Mapping[str, Any], key: str, place: str) -> list[tuple[str, dict[str, Any]]]:
    found = content.get(key)
    if not isinstance(found, dict) or not found or not all(isinstance(v, dict) for v in found.values()):
        raise ConfigError(f"{place}, {key}: expected at least one table, as in [{key}.NAME]")
    for name in found:
        if not NAME.fullmatch(name) or name.strip(". ") != name:
            raise ConfigError(
                f"{place}, {key}.{name!r}: expected letters, digits, spaces, '.', '+', '-' and '_'"
            )
    return list(found.items())


def _entry(kind: type, name: str, values: dict[str, Any], place: str) -> Any:
    kinds = {"downscale": int, "test_every": int, "set": dict, "vary": dict}
    _only(values, {f.name for f in fields(kind)} - {"name"}, place)
    for key, value in values.items():
        expected = kinds.get(key, str)
        if type(value) is not expected:
            raise ConfigError(f"{place}.{key}: expected {expected.__name__}, found {value!r}")
    if kind is SceneEntry and values.get("hold_out", "auto") not in HOLD_OUT:
        raise ConfigError(
            f"{place}.hold_out: expected one of {', '.join(HOLD_OUT)}, found {values['hold_out']!r}"
        )
    required = {"path"} if kind is SceneEntry else {"method"}
    for key in required - set(values):
        raise ConfigError(f"{place}: {key} is missing")
    return kind(name=name, **values)


def _check_method(entry: MethodEntry, place: str) -> None:
    if entry.method not in METHODS:
        raise ConfigError(
            f"{place}, methods.{entry.name}: there is no method {entry.method!r}; there are {', '.join(METHODS)}"
        )
    if len(entry.vary) > 1 or not all(isinstance(values, list) and values for values in entry.vary.values()):
        raise ConfigError(
            f"{place}, methods.{entry.name}.vary: expected one setting and a list of its values, found {entry.vary}"
        )


def _row(values: Any, place: str) -> PublishedRow:
    if not isinstance(values, dict):
        raise ConfigError(f"{place}: expected a table, found {values!r}")
    _only(values, {f.name for f in fields(PublishedRow)}, place)
    for key in ("method", "source"):
        if not isinstance(values.get(key), str):
            raise ConfigError(f"{place}: {key} is missing: who published it, and where")
    return PublishedRow(**values)


def _only(values: Mapping[str, Any], known: set[str], place: str) -> None:
    for key in values:
        if key not in known:
            raise ConfigError(f"{place}: {key!r} is unknown; there are {', '.join(sorted(known))}")
