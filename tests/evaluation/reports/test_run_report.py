"""The page says what the runs' files say, opens without a network, and stands beside its tables."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import compgs
from compgs.errors import ConfigError, OutputError, ReportError
from compgs.evaluation.reports import Column, Run, Table, report, run_pictures, run_report
from compgs.evaluation.reports.summary import points_of

from .conftest import HEIGHT, PHOTOGRAPHS, WIDTH, Maker
from .parsed_page import ParsedPage, picture_of


@pytest.fixture
def folders(make_run: Maker) -> list[Path]:
    """Two curves of three rates, one of them with two seeds, and plain 3DGS."""
    runs = [
        make_run(
            f"{preset}_{rate}_{seed}", preset=preset, lmbda=rate, seed=seed, bytes=size + 40 * seed,
            psnr=(psnr + 0.5 * seed, psnr - 3), ssim=psnr / 40,
        )
        for preset, seed, factor in (("paper", 0, 2), ("default", 0, 1), ("default", 1, 1))
        for rate, size, psnr in ((0.1, 1000 * factor, 24.0), (0.01, 4000 * factor, 27.0), (0.001, 16000 * factor, 29.0))
    ]  # fmt: skip
    return [*runs, make_run("plain", method="3dgs", bytes=10**6, psnr=(31.0, 29.0))]


def page_of(path: Path) -> ParsedPage:
    return ParsedPage(path.read_bytes())


def test_values_in_the_page_are_those_of_the_results(make_run: Maker, tmp_path: Path) -> None:
    folder = make_run("only", lmbda=0.02, bytes=56_819, psnr=(28.31550101059302,), ssim=0.9024777965123377)
    results = json.loads((folder / "results.json").read_text())
    report([folder], tmp_path / "report.html", title="Of <one> run")
    page = page_of(tmp_path / "report.html")
    assert page.row("results", "garden") == {
        "scene": "garden",
        "method": "compgs default",
        "rate": "lambda 0.02",
        "seeds": "1",
        "PSNR, dB": f"{results['psnr']:.2f}",
        "SSIM": f"{results['ssim']:.4f}",
        "bytes": f"{results['bytes']:,}",
        "anchors": "50",
        "primitives": "200",
        "training, s": "100",
        "decoding, s": "0.050",
        "frames/s": "50.0",
    }
    found = {row[3]: row[4] for row in page.tables["components"][1:]}
    assert found == {name: f"{count:,}" for name, count in results["components"].items()}
    assert "Of <one> run" in page.text and "one" not in page.tags


def test_a_page_of_many_runs_has_every_part(folders: list[Path], tmp_path: Path) -> None:
    written = report(folders, tmp_path / "new" / "report.html")
    page = page_of(written.page)
    assert (written.runs, written.scenes, len(written.notes)) == (10, 1, 1)
    assert [len(page.tables[key]) - 1 for key in ("results", "bd_rates", "components", "views")] == [
        7,
        1,
        14,
        14,
    ]
    assert page.row("bd_rates", "garden")["by PSNR"].startswith("-")
    # Two charts of quality, two of training; legends and bars are drawn, too.
    assert sum("over" in line for line in page._raw.splitlines() if '<svg class="chart"' in line) == 4
    assert page._raw.count('<svg class="bars"') == 1
    assert page.text.index("dark.jpg. Errors") < page.text.index("bright.jpg. Errors")
    assert len(written.page.read_bytes()) < 300_000


def test_the_page_asks_nothing_of_the_network(folders: list[Path], tmp_path: Path) -> None:
    report(folders, tmp_path / "report.html")
    page = page_of(tmp_path / "report.html")
    assert page.asks_nothing_of_the_network()
    assert page.images and all(address.startswith("data:image/webp;base64,") for _, address in page.images)
    assert "default-src 'none'" in page._raw


def test_a_page_that_asks_for_something_would_be_noticed() -> None:
    for asking in (b'<img src="https://a.b/c" alt="">', b"<style>@import 'a'</style>", b'<a href="b.html">'):
        assert not ParsedPage(asking).asks_nothing_of_the_network()


def test_tables_stand_beside_the_page_and_say_the_same(folders: list[Path], tmp_path: Path) -> None:
    written = report(folders, tmp_path / "r.html")
    names = {"r.html", "r.md", "r.tex", "r_results.csv", "r_bd_rates.csv", "r_components.csv", "r_views.csv"}
    assert {path.name for path in written.files} == names
    assert {path.name for path in tmp_path.iterdir() if path.is_file()} == names
    with open(tmp_path / "r_results.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    smallest = next(row for row in rows if (row["method"], row["rate"]) == ("compgs default", "lambda 0.1"))
    assert (smallest["seeds"], float(smallest["bytes"]), float(smallest["bytes_spread"])) == (
        "2",
        1020.0,
        pytest.approx(40 / 2**0.5),
    )
    assert float(smallest["ratio"]) == pytest.approx(10**6 / 1020)
    shown = page_of(tmp_path / "r.html").tables["results"][1:]
    for text in ((tmp_path / "r.md").read_text(), (tmp_path / "r.tex").read_text().replace(r"$\pm$", "±")):
        for row in shown:
            assert all(cell in text for cell in row if cell != "–")


def test_pictures_are_photograph_renderings_and_errors_of_known_differences(
    folders: list[Path], tmp_path: Path
) -> None:
    report(folders, tmp_path / "report.html", views=1)
    page = page_of(tmp_path / "report.html")
    assert page.tags.count("figure") == 1
    labels = [alt for alt, _ in page.images]
    assert labels[0] == "photograph" and len(labels) == 1 + 2 * 6
    assert (
        "compgs default, lambda 0.01: 24.00 dB" in labels
        and "errors of 3dgs, lambda 0.001: 29.00 dB" in labels
    )
    level = PHOTOGRAPHS["dark.jpg"]
    for (alt, url), expected in zip(page.images[:2], (level, level + 8), strict=True):
        picture = picture_of(url)
        assert picture.shape == (HEIGHT, WIDTH, 3), alt
        assert np.abs(picture.astype(int) - expected).max() <= 3
    # Eight levels everywhere: the end of the scale, which is white.
    errors = picture_of(next(url for alt, url in page.images if alt.startswith("errors")))
    assert errors.min() > 230 and "white is 8 of 255 levels" in page.text


def test_of_many_results_those_of_similar_size_are_shown_first_and_the_rest_is_said(
    folders: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_pictures, "SHOWN_RUNS", 3)
    written = report(folders, tmp_path / "report.html")
    (note,) = written.notes
    assert note.startswith("garden: of 7 results, pictures are shown of 3: ")
    # Sizes are 1 to 32 kB, and 1 MB of plain 3DGS: 8 kB is in the middle.
    assert note.endswith("compgs paper, lambda 0.01, compgs default, lambda 0.01, 3dgs, lambda 0.001")


def test_what_is_missing_leaves_the_rest(make_run: Maker, tmp_path: Path) -> None:
    bare = make_run("bare", method=None, pictures=False)
    (bare / "per_view.json").unlink()
    written = report([bare], tmp_path / "report.html")
    page = page_of(tmp_path / "report.html")
    assert set(page.tables) == {"results", "components"} and not page.images
    assert "Training" not in page.text
    for note in written.notes:
        assert note in page.text
    assert "no pictures: bare" in written.notes


def test_renderings_of_another_size_and_damaged_pictures_are_not_shown(
    make_run: Maker, tmp_path: Path
) -> None:
    whole, other = make_run("a", psnr=(30.0,)), make_run("b", lmbda=0.5, psnr=(20.0,))
    third = make_run("c", lmbda=0.7, psnr=(25.0,))
    Image.new("RGB", (5, 5)).save(other / "test" / "renders" / "00000.png")
    (third / "test" / "renders" / "00000.png").write_bytes(b"")
    report([whole, other, third], tmp_path / "report.html")
    labels = [alt for alt, _ in page_of(tmp_path / "report.html").images]
    assert labels == [
        "photograph",
        "compgs default, lambda 0.001: 30.00 dB",
        "errors of compgs default, lambda 0.001: 30.00 dB",
    ]


def test_perfect_pictures_are_called_identical(make_run: Maker, tmp_path: Path) -> None:
    report([make_run("a", psnr=(None, None))], tmp_path / "report.html")
    page = page_of(tmp_path / "report.html")
    assert page.row("results", "garden")["PSNR, dB"] == "identical"
    assert "compgs default, lambda 0.001: identical" in [alt for alt, _ in page.images]


def test_pictures_are_reduced_until_they_fit(
    folders: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_pictures, "WIDTH", 24)
    report(folders, tmp_path / "report.html")
    shapes = {picture_of(url).shape for _, url in page_of(tmp_path / "report.html").images}
    assert shapes == {(16, 24, 3)}


def test_runs_that_are_known_already_need_no_folder(tmp_path: Path, make_run: Maker) -> None:
    results = json.loads((make_run("a") / "results.json").read_text())
    known = [
        Run("x", "tandt", "c3dgs", rate, 0, {**results, "bytes": size})
        for rate, size in (("a", 10), ("b", 20))
    ]
    written = report(known, tmp_path / "report.html")
    assert page_of(written.page).tables["results"][1][:3] == ["tandt", "c3dgs", "a"]
    assert [point.rate for point in points_of(known)] == ["a", "b"]
    mixed = report([*known, tmp_path / "runs" / "a"], tmp_path / "mixed.html")
    assert mixed.runs == 3 and mixed.scenes == 2


def test_scenes_have_their_means_first_and_long_tables_are_folded_or_left_to_the_csv(
    make_run: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders = [make_run("a", bytes=1000), make_run("b", bytes=3000, scene="room")]
    report(folders, tmp_path / "few.html")
    page = page_of(tmp_path / "few.html")
    assert list(page.tables)[:2] == ["means", "results"]
    assert page.row("means", "compgs default")["bytes"] == "2,000"
    assert page.tags.count("details") == 2  # components and views
    monkeypatch.setattr(run_report, "OPEN_ROWS", 1)
    monkeypatch.setattr(run_report, "MOST_ROWS", 3)
    report(folders, tmp_path / "many.html")
    page = page_of(tmp_path / "many.html")
    assert page.tags.count("details") == 1 and "Every scene" in page.text
    assert set(page.tables) == {"means", "results"}
    assert "Views: 4 rows, in many_views.csv." in page.text


def test_tables_of_others_stand_behind_those_of_the_runs(make_run: Maker, tmp_path: Path) -> None:
    columns = (Column("method", "method"), Column("psnr", "PSNR, dB", ".2f"))
    published = Table("published", "As published", columns, (("Somebody", 27.256),))
    written = report([make_run("a")], tmp_path / "r.html", others=[published])
    assert written.tables[-1] is published
    assert page_of(tmp_path / "r.html").row("published", "Somebody")["PSNR, dB"] == "27.26"
    assert (tmp_path / "r_published.csv").read_text().splitlines()[1] == "Somebody,27.256"


def test_an_existing_report_or_table_is_kept_unless_asked(make_run: Maker, tmp_path: Path) -> None:
    folder = make_run("a")
    (tmp_path / "report_results.csv").write_text("precious")
    with pytest.raises(OutputError, match=r"report_results\.csv: exists already"):
        report([folder], tmp_path / "report.html")
    assert {path.name for path in tmp_path.iterdir()} == {"report_results.csv", "runs"}
    report([folder], tmp_path / "report.html", overwrite=True)
    assert (tmp_path / "report_results.csv").read_text().startswith("scene,method")


def test_mistakes_are_said_before_anything_is_written(make_run: Maker, tmp_path: Path) -> None:
    folder = make_run("a")
    with pytest.raises(OutputError, match=r"ends in \.html"):
        report([folder], tmp_path / "report.pdf")
    with pytest.raises(ConfigError, match="reference 'best'"):
        report([folder], tmp_path / "report.html", reference="best")
    with pytest.raises(ReportError, match="no runs"):
        report([], tmp_path / "report.html")
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]
    assert compgs.report is report
