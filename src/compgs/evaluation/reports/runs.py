"""Runs for a report: what the folders of trainings and evaluations hold, and which of them belong together.

A run is one scene, one method at one rate, one seed. Folders say which: `config.json`, as `compgs train` leaves it, has
the method, the preset and all settings. What is missing in a folder is left out of the report and said there.
"""

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from compgs.config import PRESETS, Config
from compgs.errors import ReportError

RESULTS_NAME = "results.json"
SCHEMA = "compgs results 1"
USUAL_SPLIT = "one in 8 by name"  # of `split` in results.json
NEEDED = ("scene", "psnr", "ssim", "bytes", "components", "width", "height")  # of results.json
# Settings of which a run's rate and seed are known already.
RATE_SETTINGS = ("training.lmbda", "training.target_bytes")
SEED_SETTING = "training.seed"
OURS = "compgs"  # method whose presets are different curves; those that other methods have of their own are rates
SHARED_SECTIONS = tuple(
    Config().to_dict()
)  # of the settings; a method's own section holds what sets its rate


@dataclass(frozen=True, eq=False)
class Run:
    """One training, or one evaluation of a file."""

    name: str
    scene: str
    method: str  # name of its curve: runs of one method at several rates form one
    rate: str  # what sets it apart on the curve, such as `lambda 0.001`; empty where there is but one
    seed: int | None
    results: Mapping[str, Any]  # content of results.json
    per_view: tuple[Mapping[str, Any], ...] = ()  # content of per_view.json
    training: Mapping[str, Any] = field(default_factory=dict)  # content of training.json
    folder: Path | None = None  # with test/renders and test/gt
    missing: tuple[str, ...] = ()  # what the folder lacks

    def value(self, name: str) -> float | None:
        """A number of results.json; of a PSNR that is null there, of equal pictures, infinity."""
        found = self.results.get(name)
        if found is None and name == "psnr":
            return float("inf")
        return found if isinstance(found, int | float) else None

    def pictures(self, file: str) -> tuple[Path, Path] | None:
        """Photograph and rendering of a view, if both are there."""
        if self.folder is None:
            return None
        pair = self.folder / "test" / "gt" / file, self.folder / "test" / "renders" / file
        return pair if all(path.is_file() for path in pair) else None


def read_runs(folders: Iterable[str | Path]) -> tuple[list[Run], tuple[str, ...]]:
    """The runs in some folders, in their order; and in words which folders and parts of runs are left out.

    A folder without results of its own stands for the folders in it. Raises ReportError if there is no run at all.
    """
    found: list[_Found] = []
    given, left_out = _run_folders(folders)
    for folder in given:
        try:
            found.append(_read(folder))
        except ReportError as reason:
            left_out.append(str(reason))
    if not found:
        raise ReportError(
            "there are no runs to report on"
            + "".join(f"; {reason}" for reason in left_out[:3])
            + ("; ..." if len(left_out) > 3 else "")
        )
    runs = _named_apart(found)
    return runs, (*left_out, *_lacks(runs))


@dataclass(frozen=True, eq=False)
class _Found:
    """A run, and what tells it from others."""

    run: Run
    kind: tuple[str, str]  # method and preset
    settings: dict[str, Any]  # `section.key`, of config.json


def _run_folders(paths: Iterable[str | Path]) -> tuple[list[Path], list[str]]:
    """And which paths are none. Raises ReportError for one that is not there: it was misspelled."""
    folders: list[Path] = []
    others: list[Path] = []
    for path in map(Path, paths):
        if not path.exists():
            raise ReportError(f"{path}: does not exist; expected the folder of a run")
        if not path.is_dir():  # `runs/*` names files, too
            others.append(path)
            continue
        inside = [] if (path / RESULTS_NAME).exists() else sorted(path.glob(f"*/{RESULTS_NAME}"))
        folders += [file.parent for file in inside] or [path]
    named = others[0] if len(others) == 1 else f"{others[0]} and {len(others) - 1} more" if others else ""
    return list(dict.fromkeys(folders)), [f"{named}: no folder of a run"] if others else []


def _read(folder: Path) -> _Found:
    """Raises ReportError for a folder that has no results, or not such as ours."""
    results = _json(folder / RESULTS_NAME, dict)
    if results is None:
        raise ReportError(f"{folder}: no {RESULTS_NAME} (not finished, or not evaluated)")
    lacking = [key for key in NEEDED if key not in results]
    if results.get("schema") != SCHEMA or lacking:
        what = f"{lacking[0]!r} is missing" if lacking else f"its schema is {results.get('schema')!r}"
        raise ReportError(f"{folder / RESULTS_NAME}: {what}; expected {SCHEMA!r}")
    config = _json(folder / "config.json", dict) or {}
    training = _json(folder / "training.json", dict)
    per_view = _json(folder / "per_view.json", list)
    lacks = {
        "config.json": not config,
        "training.json": training is None,
        "training curve": training is not None and not training.get("curve"),
        "per_view.json": per_view is None,
        "pictures": not (folder / "test" / "renders").is_dir(),
    }
    settings = _flat(config.get("settings") or {})
    run = Run(
        name=folder.resolve().name,
        scene=str(results["scene"]),
        method=_method(config, folder),
        rate=_rate(config, settings, training or {}),
        seed=settings.get(SEED_SETTING),
        results=results,
        per_view=tuple(per_view or ()),
        training=training or {},
        folder=folder,
        missing=tuple(name for name, is_lacking in lacks.items() if is_lacking),
    )
    return _Found(run, (str(config.get("method", OURS)), str(config.get("preset", ""))), settings)


def _json(path: Path, kind: type) -> Any:
    """Content of a file that is there. Raises ReportError for one that is damaged."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise ReportError(f"{path}: cannot be read ({error})") from error
    if not isinstance(content, kind):
        raise ReportError(f"{path}: expected a {kind.__name__} of JSON, found {type(content).__name__}")
    return content


def _flat(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {
        f"{section}.{key}": tuple(value) if isinstance(value, list) else value
        for section, values in settings.items()
        if isinstance(values, dict)
        for key, value in values.items()
    }


def _method(config: Mapping[str, Any], folder: Path) -> str:
    """`compgs default`, `3dgs`, `3dgs quick`; without settings the name of the folder."""
    if not config:
        return folder.resolve().name
    method, preset = str(config.get("method", OURS)), str(config.get("preset", "default"))
    shared = preset in PRESETS and preset != "default"
    return f"{method} {preset}" if method == OURS or shared else method


def _rate(config: Mapping[str, Any], settings: Mapping[str, Any], training: Mapping[str, Any]) -> str:
    """Name the rate of a run: of ours lambda, or the size that was asked for; of others the preset of their own, and
    lambda if they have it.
    """
    own = config.get("method", OURS) != OURS
    preset = config.get("preset", "default")
    parts = [str(preset)] if own and preset not in PRESETS else []
    target, lmbda = settings.get(RATE_SETTINGS[1]), settings.get(RATE_SETTINGS[0])
    if target is not None and not own:
        parts.append(f"{target:,} bytes asked")
    elif lmbda is not None and (not own or "lmbda" in training):
        parts.append(f"lambda {lmbda:g}")
    return ", ".join(parts)


def _named_apart(found: Sequence[_Found]) -> list[Run]:
    """Names of scenes with their sizes, and of methods with the settings, where runs would be mixed up without."""
    sizes: dict[str, set[tuple[int, int]]] = {}
    for each in found:
        sizes.setdefault(each.run.scene, set()).add(_size(each.run))
    ambiguous = {scene for scene, of_scene in sizes.items() if len(of_scene) > 1}
    scened = [
        replace(each, run=replace(each.run, scene=f"{each.run.scene} ({_size(each.run)[0]} px)"))
        if each.run.scene in ambiguous
        else each
        for each in found
    ]
    scened = _split_apart(scened)
    named = []
    for each in scened:
        differing = _differing(each, scened)
        own = [part for part in differing if part.partition(".")[0] not in SHARED_SECTIONS]
        method = ", ".join([each.run.method, *(part for part in differing if part not in own)])
        rate = ", ".join([*([each.run.rate] if each.run.rate else []), *own])
        named.append(replace(each.run, method=method, rate=rate))
    return named


def _split_apart(found: Sequence[_Found]) -> list[_Found]:
    """Names of scenes with how views were held out, where runs differ in that and it is not the usual way."""
    splits: dict[str, set[str]] = {}
    for each in found:
        if split := str(each.run.results.get("split") or ""):  # runs from before this was noted are usual
            splits.setdefault(each.run.scene, {USUAL_SPLIT}).add(split)

    def named(run: Run) -> Run:
        split = run.results.get("split") or USUAL_SPLIT
        if split == USUAL_SPLIT or len(splits[run.scene]) < 2:
            return run
        return replace(run, scene=f"{run.scene} ({split})")

    return [replace(each, run=named(each.run)) for each in found]


def _size(run: Run) -> tuple[int, int]:
    return run.results["width"], run.results["height"]


def _differing(one: _Found, found: Sequence[_Found]) -> list[str]:
    """`training.steps=500`: settings in which runs of one method and preset differ, on any scene; not rate and seed."""
    peers = [each.settings for each in found if each.kind == one.kind]
    return [
        f"{key}={value}"
        for key, value in one.settings.items()
        if key not in (*RATE_SETTINGS, SEED_SETTING)
        and any(settings.get(key, value) != value for settings in peers)
    ]


def _lacks(runs: Sequence[Run]) -> list[str]:
    """`no training curve: 3 runs (a, b, ...)`."""
    counts = Counter(what for run in runs for what in run.missing)
    return [
        f"no {what}: {', '.join(run.name for run in runs if what in run.missing)}"
        if count < len(runs) or count == 1
        else f"no {what}: all runs"
        for what, count in counts.items()
    ]
