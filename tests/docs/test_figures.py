"""The figures of the pages are those of their records, and the records are those of today's default preset."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from compgs.config import load_config
from compgs.training.plan import RULES, Start, plan

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "tools"))
import figures  # noqa: E402

RECORDS = sorted((ROOT / "docs" / "results" / "records").glob("*.json"))
# What a command says of a run; all else is the preset's.
ASKED = {"training.lmbda", "training.steps"}


def test_every_page_has_the_figures_of_its_records() -> None:
    differ = [page for page in figures.pages() if (text := page.read_text()) != figures.rewritten(text)]
    assert differ == [], "run tools/figures.py"


def test_a_figure_that_somebody_changes_by_hand_is_found() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (record,) = (record for record in figures.records() if record["name"] == "truck")
    shown = f"{record['results']['psnr']:.2f} dB"
    assert shown in text
    assert figures.rewritten(text.replace(shown, "99.99 dB")) == text


def test_readme_has_no_figure_of_quality_or_size_but_those_of_records() -> None:
    text = figures.BLOCK.sub("", (ROOT / "README.md").read_text(encoding="utf-8"))
    prose = re.sub(r"^```.*?^```", "", text, flags=re.S | re.M)
    assert re.findall(r"[\d.]+ ?(?:dB|kB|MB|GB|min|seconds|%)", prose) == []


def test_readme_is_two_screens() -> None:
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 120 and max(map(len, lines)) <= 120


@pytest.mark.parametrize("path", RECORDS, ids=lambda path: path.stem)
def test_a_record_is_of_a_run_that_the_default_of_today_would_make(path: Path) -> None:
    record = json.loads(path.read_text(encoding="utf-8"))
    today = load_config(record["preset"])
    asked = {name: record["settings"]["training"][name] for name in ("lmbda", "steps")}
    config = replace(today, training=replace(today.training, **asked))
    start = Start(**record["plan"]["start"])
    decided = plan(config, start).to_dict()
    assert {k: v for k, v in record["plan"].items() if k not in ("reasons", "start")} == {
        k: v for k, v in decided.items() if k in record["plan"] and k not in ("reasons", "start")
    }
    by_rules = {rule.sets for rule in RULES}
    before, after = flat(record["settings"]), flat(json.loads(json.dumps(config.to_dict())))
    other = {
        name
        for name in before
        if before[name] != after.get(name) and name not in ASKED and name.rpartition(".")[2] not in by_rules
    }
    assert other == set(), "measure it again, or take its rows out of README.md"


@pytest.mark.parametrize("path", RECORDS, ids=lambda path: path.stem)
def test_a_record_says_where_it_is_from_and_its_parts_make_the_whole(path: Path) -> None:
    record = json.loads(path.read_text(encoding="utf-8"))
    assert re.fullmatch(r"[0-9a-f]{7}", record["commit"]) and record["command"].startswith("compgs train ")
    assert record["machine"]["processor"] and (ROOT / "docs" / "results" / record["page"]).is_file()
    assert sum(record["results"]["components"].values()) == record["results"]["bytes"]


def flat(settings: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return section.name -> value."""
    return {
        f"{section}.{name}": value for section, values in settings.items() for name, value in values.items()
    }
