"""The figures of the pages are those of their records, and say so if the preset of today would give others."""

import json
import re
import sys
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from compgs.config import load_config
from compgs.former_settings import FORMER_RULES
from compgs.training.plan import RULES, Start, plan

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "tools"))
import figures  # noqa: E402

RECORDS = sorted((ROOT / "docs" / "results" / "records").glob("*.json"))


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
    prose = [line for line in lines if not line.startswith("|")]  # rows of tables are laid out anew
    assert len(lines) <= 120 and max(map(len, prose)) <= 120


@pytest.mark.parametrize("path", RECORDS, ids=lambda path: path.stem)
def test_a_row_names_its_commit_if_today_it_would_be_trained_otherwise_or_a_later_one_has_its_place(
    path: Path,
) -> None:
    record = json.loads(path.read_text(encoding="utf-8"))
    today = load_config(record["preset"])
    asked = {name: record["settings"]["training"][name] for name in ("lmbda", "steps")}
    now = plan(
        replace(today, training=replace(today.training, **asked)), Start(**record["plan"]["start"])
    ).to_dict()
    same = all(
        record["plan"].get(name, 0) == value
        for name, value in now.items()
        if name not in ("start", "reasons")
    ) and not any(record["plan"].get(name) for name in FORMER_RULES)
    decided, ran = {rule.sets for rule in RULES}, record["settings"]["training"]
    by_itself = {
        n: v for n, v in asdict(today.training).items() if n not in decided and n not in figures.ASKED
    }
    same = same and all(ran.get(n) == v for n, v in json.loads(json.dumps(by_itself)).items())
    same = same and record["name"] not in figures.SUPERSEDED
    captures = (ROOT / "docs" / "results" / "captures.md").read_text(encoding="utf-8")
    assert (f"| {record['title']}, at {record['commit']} |" in captures) == (not same)
    if record["name"] not in figures.SUPERSEDED:
        readme = (ROOT / "README.md").read_text(encoding="utf-8")
        assert (f"{record['page']}), at {record['commit']} |" in readme) == (not same)


def test_a_record_of_todays_preset_is_not_outdated_and_one_of_another_is() -> None:
    (record,) = (record for record in figures.records() if record["name"] == "truck")
    start = Start(**record["plan"]["start"])
    today = load_config("default")
    asked = {name: record["settings"]["training"][name] for name in ("lmbda", "steps")}
    config = replace(today, training=replace(today.training, **asked))
    settings = json.loads(json.dumps(config.to_dict()))  # as a run keeps them
    fresh = {**record, "settings": settings, "plan": plan(config, start).to_dict()}
    assert figures.outdated(fresh) == []
    assert figures.outdated({**fresh, "plan": {**fresh["plan"], "width": 8}}) == ["width"]
    other = {**fresh["settings"], "training": {**fresh["settings"]["training"], "ssim_weight": 0.5}}
    assert figures.outdated({**fresh, "settings": other}) == ["training.ssim_weight"]


@pytest.mark.parametrize("path", RECORDS, ids=lambda path: path.stem)
def test_a_record_says_where_it_is_from_and_its_parts_make_the_whole(path: Path) -> None:
    record = json.loads(path.read_text(encoding="utf-8"))
    assert re.fullmatch(r"[0-9a-f]{7}", record["commit"]) and record["command"].startswith("compgs train ")
    assert record["machine"]["processor"] and (ROOT / "docs" / "results" / record["page"]).is_file()
    assert sum(record["results"]["components"].values()) == record["results"]["bytes"]
