"""Writes the figures of README.md and of the pages from the records beside them.

    python tools/figures.py            # writes
    python tools/figures.py --check    # says which pages differ from their records, and writes nothing

A page has figures between two comments, `<!-- figures: NAME -->` and `<!-- end of figures -->`. NAME says what stands
there: a function of this file, and what it is given. Records are docs/results/records/*.json, which tools/record.py
writes, and the tables and records that the benchmarks leave in docs/results. A row whose run today's preset would train
otherwise names its commit. A test compares all pages with their records.
"""

import argparse
import csv
import json
import re
import sys
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from compgs.config import load_config
from compgs.errors import ConfigError
from compgs.former_settings import FORMER_RULES, without_former
from compgs.outputs import write_bytes
from compgs.training.plan import RULES, Plan, plan

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
sys.path.append(str(ROOT / "benchmarks"))
import ablation_tables  # noqa: E402
import beside as beside_benchmark  # noqa: E402
import complexity  # noqa: E402
import prefix as prefix_benchmark  # noqa: E402
import quality_over_bytes  # noqa: E402
import similarity  # noqa: E402
import similarity_measures  # noqa: E402
import suite_tables  # noqa: E402

BLOCK = re.compile(
    r"(?P<head>^<!-- figures: (?P<name>[^\n]*?) -->\n).*?(?P<foot>^<!-- end of figures -->$)",
    re.DOTALL | re.MULTILINE,
)

# The records that come first in the tables: the paper's scenes.
FIRST = (
    "truck_adjusted_30000",
    "truck_adjusted_rate8",
    "truck_adjusted_1e-2",
    "truck_adjusted_4e-3",
    "truck_adjusted_4e-4",
    "truck_adjusted_two_looks",
    "truck_adjusted_shallow",
    "truck_adjusted_whole",
    "truck_adjusted_18000",
    "truck",
    "truck_adjusted",
    "truck_adjusted_1e-3",
    "truck_adjusted_default",
    "bonsai_rate8",
    "bonsai_1e-2",
    "bonsai_4e-3",
    "bonsai_default",
    "bonsai_1e-3",
    "bonsai",
)
# Records of which only the pages of the captures speak: a later one of the same capture has the same command, or is no
# worse by any measure, as tables print it, in at most a tenth more bytes.
SUPERSEDED = (
    "truck_adjusted_two_looks",
    "truck_adjusted_shallow",
    "truck_adjusted",
    "truck_adjusted_1e-3",
    "truck_adjusted_default",
    "truck_adjusted_whole",
    "bonsai",
    "bonsai_default",
)
# Of a run, said by its command; all else is the preset's.
ASKED = ("lmbda", "steps", "seed", "target_bytes")
Record = dict[str, Any]


def pages() -> list[Path]:
    """Return every page that may have figures."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def rewritten(text: str) -> str:
    """Return a page with all its figures made anew."""
    return BLOCK.sub(lambda found: found["head"] + figures(found["name"]) + "\n" + found["foot"], text)


def figures(name: str) -> str:
    """Return the figures of this name: a function, and the words that it is given."""
    function, *given = name.split()
    return FUNCTIONS[function](*given)


# records ------------------------------------------------------------------------------------------------------------


def records() -> list[Record]:
    """Return all records, in the order of the tables."""
    found = [_json(path) for path in (RESULTS / "records").glob("*.json")]
    return sorted(found, key=lambda record: (record["name"] not in FIRST, -record["results"]["bytes"]))


def outdated(record: Record) -> list[str]:
    """Return the settings and decisions that today's preset would have otherwise in the run of a record."""
    today = load_config(record["preset"])
    asked = {name: record["settings"]["training"][name] for name in ASKED}
    config = replace(today, training=replace(today.training, **asked))
    ran = Plan.from_dict(
        record["plan"]
    )  # a decision that the run did not know yet has the value that changes nothing
    now = plan(config, ran.start)
    decided = {f.name for f in fields(Plan)} - {"start", "reasons"}
    found = [name for name in sorted(decided) if getattr(ran, name) != getattr(now, name)]
    found += [name for name in FORMER_RULES if record["plan"].get(name)]
    try:
        settings = without_former(record["settings"], record["name"])
    except ConfigError:
        return [*found, "a setting that there is no more"]
    before, after = flat(settings), flat(json.loads(json.dumps(config.to_dict())))
    by_rules = {rule.sets for rule in RULES}
    found += [n for n in before if before[n] != after.get(n) and n.rpartition(".")[2] not in by_rules]
    return found


def flat(settings: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return section.name -> value."""
    return {
        f"{section}.{name}": value for section, values in settings.items() for name, value in values.items()
    }


def titled(record: Record, link: str) -> str:
    """Return the name of the capture, and the commit if today's preset would train otherwise or a later record has its
    place.
    """
    otherwise = outdated(record) or record["name"] in SUPERSEDED
    return link + (f", at {record['commit']}" if otherwise else "")


def captures(folder: str) -> str:
    """A row for each record that is not superseded, in a few columns. `folder` leads from the page to docs/results."""
    lines = [
        "| capture | training views, pixels | steps | training | PSNR | SSIM | file |",
        "|---|---|---|---|---|---|---|",
    ]
    for record in records():
        if record["name"] in SUPERSEDED:
            continue
        results, title = record["results"], titled(record, f"[{record['title']}]({folder}/{record['page']})")
        lines.append(
            f"| {title} | {views(record)} | {number(record['training']['steps'])} | {minutes(record)} | "
            f"{results['psnr']:.2f} dB | {results['ssim']:.3f} | **{size(results['bytes'])}** |"
        )
        lines += [
            f"| {record['title']}, {which} of the paper | | 30 000 | | {row['psnr']:.2f} dB | "
            f"{row['ssim']:.2f} | {size(row['bytes'])} |"
            for which, row in zip(("largest file", "smallest"), published(record["name"]), strict=False)
        ]
    return "\n".join(lines)


def published(name: str) -> list[Record]:
    """The paper's own rows of a capture, largest file and smallest, where there is a suite with them."""
    suite = ROOT / "src" / "compgs" / "suites" / "shipped" / f"{name}.toml"
    if not suite.is_file():
        return []
    rows = tomllib.loads(suite.read_text(encoding="utf-8"))["published"]
    mine = sorted((row for row in rows if row["method"] == "CompGS"), key=lambda row: -row["bytes"])
    return [mine[0], mine[-1]]


def printed(name: str) -> str:
    """What other authors printed of a capture, from its suite."""
    suite = ROOT / "src" / "compgs" / "suites" / "shipped" / f"{name}.toml"
    rows = tomllib.loads(suite.read_text(encoding="utf-8"))["published"]
    lines = ["| method | PSNR | SSIM | LPIPS, as 3DGS | file | source |", "|---|---:|---:|---:|---:|---|"]
    for row in sorted(rows, key=lambda row: -row["bytes"]):
        method = " ".join([row["method"], *([f"({row['rate']})"] if "rate" in row else [])])
        quality = f"{row['psnr']:.2f} dB | {row['ssim']:.3g} | {row['lpips_3dgs']:.3g}"
        lines.append(f"| {method} | {quality} | {size(row['bytes'])} | {row['source']} |")
    return "\n".join(lines)


SHOWN = {
    "city": "16 blocks of houses, made by `tools/made_city.py`, seen from the air",
    "brighton": "a park by a lake, from 18 photographs that a drone took; they leave the trees blurred",
    "demo": "balls, boxes and a floor, made by `compgs demo-scene` and trained by `make demo`",
}


def gallery() -> str:
    """A row for each file of the gallery."""
    lines = ["| scene | open | file | bytes | what it shows |", "|---|---|---|---:|---|"]
    for file in sorted((ROOT / "docs" / "gallery").glob("*.cgs")):
        page = f'<a href="gallery/{file.stem}.html">page</a>'
        bytes_ = number(file.stat().st_size)
        lines.append(
            f"| {file.stem} | {page} | [{file.name}](gallery/{file.name}) | {bytes_} | {SHOWN[file.stem]} |"
        )
    return "\n".join(lines)


def measured(*names: str) -> str:
    """A row for each record of these names, or for each, with all that was measured."""
    head = ["capture", "command", "commit", "held-out views", "PSNR", "SSIM", "LPIPS, as 3DGS / as trained"]
    head += ["bytes", "anchors", "bits an anchor", "training", "decoding", "a view"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for record in records():
        if names and record["name"] not in names:
            continue
        r = record["results"]
        lpips = "" if r["lpips"] is None else f"{r['lpips_3dgs']:.3f} / {r['lpips']:.3f}"
        cells = [
            titled(record, record["title"]),
            f"`{record['command']}`",
            record["commit"],
            f"{r['views']} of {r['width']} x {r['height']}",
            f"{r['psnr']:.2f} dB",
            f"{r['ssim']:.4f}",
            lpips,
            number(r["bytes"]),
            number(r["anchors"]),
            f"{r['bits_per_anchor']:.1f}",
            *times(record),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def times(record: Record) -> list[str]:
    """Of training, decoding and rendering; only why there are none, where other work made them meaningless."""
    r, note = record["results"], record["note"]
    if not is_timed(record):
        return [note, "", ""]
    ms = [f"{1e3 * r[name]:.0f} ms" for name in ("decode_seconds", "render_seconds")]
    return [f"{minutes(record)} {note}".strip(), *ms]


def is_timed(record: Record) -> bool:
    return not record["note"].startswith("not timed")


def components(name: str) -> str:
    """Where the bytes of a record's file are."""
    (record,) = (record for record in records() if record["name"] == name)
    r = record["results"]
    lines = ["| part of the file | bytes | share | bits an anchor |", "|---|---:|---:|---:|"]
    for part, amount in sorted(r["components"].items(), key=lambda item: -item[1]):
        if amount:
            share, bits = amount / r["bytes"], 8 * amount / r["anchors"]
            lines.append(f"| {part} | {number(amount)} | {share:.1%} | {bits:.2f} |")
    lines.append(f"| **all** | **{number(r['bytes'])}** | 100.0% | {r['bits_per_anchor']:.2f} |")
    return "\n".join(lines)


def views(record: Record) -> str:
    results = record["results"]
    return f"{record['plan']['start']['views']} at {results['width']} x {results['height']}"


def minutes(record: Record) -> str:
    """The seconds of the training, as people say them; none where other work made them meaningless."""
    if not is_timed(record):
        return "not timed"
    seconds = record["training"]["seconds"]
    return f"{seconds / 60:.0f} min" if seconds >= 600 else f"{seconds / 60:.1f} min"


def size(amount: int) -> str:
    return f"{amount / 1e6:.2f} MB" if amount >= 1e6 else f"{amount / 1e3:.0f} kB"


def number(value: int) -> str:
    """With a space between thousands, as the pages have it."""
    return f"{value:,}".replace(",", " ")


# the paper's tables and figures --------------------------------------------------------------------------------------

# As the paper prints them, MB of 2^20 bytes; measured are captures of this project, smaller and in fewer steps.
PRINTED_COMPONENTS = "Truck: 25.41 dB in 611 MB, 25.20 dB in 30.4 MB, 25.28 dB in 10.6 MB"
PRINTED_RESIDUALS = "Train: 20.50 dB in 5.75 MB without, 21.49 dB in 5.51 MB with"
PRINTED_COUPLED = "Train: 22.04, 22.12, 21.90 dB in 7.87, 8.60, 8.28 MB for K = 5, 10, 15"
PRINTED_COMPLEXITY = (
    "Tanks and Temples: training 37.8 min, encoding 6.3 s, decoding 4.5 s, a view 5.3 ms, on its GPU"
)


def paper() -> str:
    """A row for each table and figure of the paper: printed, and measured here."""
    truck = next(record for record in records() if record["name"] == "truck_adjusted")["results"]
    times = _json(RESULTS / "complexity_plush_480.json")["rows"]["paper"]
    alike = _json(RESULTS / "similarity_plush_480.json")
    every = next(row for row in alike["rows"] if row["attribute"] == "all together")
    bits = ablation_rows("bitstream_plush_480")
    rows = [
        (
            "Fig. 1, quality and size beside other methods",
            "a chart",
            "our default beside eleven other files",
            "compared.md",
        ),
        (
            "Fig. 2, similarity of neighbouring Gaussians",
            "a chart",
            f"plush: cosine {every['neighbours']:.2f} to neighbours, {every['random']:.2f} to random splats",
            "results/similarity_plush_480.md",
        ),
        ("Fig. 3 to 5, overview, prediction, entropy models", "drawings", "pictures of a file", "method.md"),
        (
            "Fig. 6, rate-distortion curves",
            "charts",
            "curves of presets `paper` and `default` on three captures",
            "results/ablation_curve_plush_480.md",
        ),
        ("Fig. 7, pictures", "pictures", "a gallery to open", "gallery.md"),
        (
            "Fig. 8, bits an anchor and a coupled primitive",
            "a chart (Train)",
            "plush, lambda 0.001, 0.005, 0.01: "
            + ", ".join(f"{a:.0f} and {c:.1f}" for a, c in map(ablation_tables.bits_each, bits)),
            "results/ablation_bitstream_plush_480.md",
        ),
        (
            "Table 1 and appendix, Tanks and Temples",
            "Truck: 25.28 dB in 10.6 MB to 24.72 dB in 6.27 MB",
            f"Truck, `default`, adjusted cameras: {truck['psnr']:.2f} dB in {size(truck['bytes'])}; Train was not run",
            "results/truck.md",
        ),
        ("Table 2, Deep Blending", "29.30 to 29.69 dB", "not run", "results/README.md"),
        ("Table 3, Mip-NeRF 360", "26.37 to 27.26 dB", "not run at its size", "results/README.md"),
        (
            "Table 4, parts of the method",
            PRINTED_COMPONENTS,
            plush("components"),
            "results/ablation_components_plush_480.md",
        ),
        (
            "Table 5, residual embeddings",
            PRINTED_RESIDUALS,
            plush("residuals"),
            "results/ablation_residuals_plush_480.md",
        ),
        ("Table 6, K", PRINTED_COUPLED, plush("coupled"), "results/ablation_coupled_plush_480.md"),
        (
            "Table 7, complexity",
            PRINTED_COMPLEXITY,
            f"plush, preset `paper`, two CPU cores: {times['train']['seconds'] / 60:.1f} min, "
            f"{times['encode']['seconds']:.2f} s, "
            f"{times['decode']['seconds']:.2f} s, {1e3 * times['render']['seconds']:.0f} ms",
            "results/complexity_plush_480.md",
        ),
    ]
    lines = ["| in the paper | printed | measured here | page |", "|---|---|---|---|"]
    lines += [f"| {what} | {printed} | {mine} | [page]({page}) |" for what, printed, mine, page in rows]
    return "\n".join(lines)


def plush(name: str) -> str:
    """The variants of an ablation on plush, in words."""
    rows = ablation_rows(f"{name}_plush_480")
    return "plush: " + "; ".join(
        f"{row.label} {row.psnr:.2f} dB in {size(int(row.bytes or 0))}" for row in rows
    )


def ablation_rows(name: str) -> list[ablation_tables.Row]:
    return ablation_tables.rows_of(_json(RESULTS / f"ablation_{name}.json")["records"])


# tables of the benchmarks -------------------------------------------------------------------------------------------

# What stands in the comparison for each method: the variant as published where there are several.
COMPARED = {
    "compgs paper": "this program's `paper` preset, at its best",
    "cosa-gs": "COSA-GS, at its best",
    "Scaffold-GS published": "Scaffold-GS",
    "3dgs": "plain 3DGS (`.ply`)",
    "sog": "plain 3DGS as `.sog`",
    "spz": "plain 3DGS as `.spz`",
    "c3dgs published": "c3dgs",
    "Compact3D BitQ": "Compact3D, BitQ, at its best",
    "LightGaussian published": "LightGaussian",
    "EAGLES published": "EAGLES",
    "Compact-3DGS published": "Compact-3DGS",
}


def methods(scene: str) -> str:
    """All methods on one capture."""
    return suite_tables.table(_csv(RESULTS / f"methods_{scene}.csv"))


def compared(scene: str) -> str:
    """One row a method: its best file by SSIM, and how many times the bytes of ours at that SSIM, and at that PSNR."""
    rows = _csv(RESULTS / f"methods_{scene}.csv")
    curves = {measure: suite_tables.our_curve(rows, measure) for measure in ("psnr", "ssim")}
    lines = [
        "| method | PSNR | SSIM | bytes | times our bytes at its PSNR | at its SSIM |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    ours = best(rows, "compgs default")
    lines.append(
        f"| **CompGS, `default`, largest file** | {quality(ours)} | {number(int(ours['bytes']))} | | |"
    )
    for name, title in COMPARED.items():
        row = best(rows, name)
        times = [suite_tables.times(curve, int(row["bytes"]), float(row[m])) for m, curve in curves.items()]
        lines.append(f"| {title} | {quality(row)} | {number(int(row['bytes']))} | {times[0]} | {times[1]} |")
    return "\n".join(lines)


def best(rows: Sequence[dict[str, str]], method: str) -> dict[str, str]:
    """The row of the method with the best SSIM."""
    return max((row for row in rows if row["method"] == method), key=lambda row: float(row["ssim"]))


def quality(row: dict[str, str]) -> str:
    return f"{float(row['psnr']):.2f} dB | {float(row['ssim']):.3f}"


def ablation(name: str) -> str:
    """The variants of an ablation."""
    return ablation_tables.table(ablation_tables.rows_of(_json(RESULTS / f"ablation_{name}.json")["records"]))


def ablation_components(name: str) -> str:
    """Bytes by component of the variants of an ablation."""
    rows = ablation_tables.rows_of(_json(RESULTS / f"ablation_{name}.json")["records"])
    return ablation_tables.component_table(rows)


def complexity_time(name: str) -> str:
    """Times of training, encoding, decoding and rendering."""
    return complexity.time_table(_json(RESULTS / f"complexity_{name}.json")["rows"])


def complexity_memory(name: str) -> str:
    """Memory of training, encoding, decoding and rendering."""
    return complexity.memory_table(_json(RESULTS / f"complexity_{name}.json")["rows"])


def curves(name: str, *tables: str) -> str:
    """Quality over bytes, from the records of ablations."""
    every = [
        record
        for table in tables
        for record in quality_over_bytes.read_records(RESULTS / f"{table}_{name}.json")
    ]
    return quality_over_bytes.table(quality_over_bytes.points_of(quality_over_bytes.drawn(every)))


def beside(name: str) -> str:
    """Return the files of a scene beside those of other programs (benchmarks/beside.py)."""
    return beside_benchmark.table(_json(RESULTS / f"beside_{name}.json"))


def prefix(name: str) -> str:
    """Quality of the beginnings of a file."""
    lines = prefix_benchmark.report({**_json(RESULTS / f"prefix_{name}.json"), "commit": ""}, "").splitlines()
    return "\n".join(line for line in lines if line.startswith("|"))


def similar(name: str) -> str:
    """How alike neighbouring splats are."""
    rows = [
        similarity_measures.Similarity(**row) for row in _json(RESULTS / f"similarity_{name}.json")["rows"]
    ]
    return similarity.table(rows)


FUNCTIONS: dict[str, Callable[..., str]] = {
    function.__name__: function
    for function in (
        captures, printed, gallery, measured, paper, components, methods, compared, ablation, ablation_components,
        complexity_time, complexity_memory, curves, prefix, similar, beside,
    )
}  # fmt: skip


def _json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def _csv(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return [row for row in csv.DictReader(file) if not row["method"].endswith("(published)")]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="write nothing, and fail if a page differs")
    check = parser.parse_args().check
    differ = []
    for page in pages():
        text = page.read_text(encoding="utf-8")
        if (new := rewritten(text)) != text:
            differ.append(str(page.relative_to(ROOT)))
            if not check:
                write_bytes(page, new.encode())
    print("\n".join(differ) or "all pages have the figures of their records")
    sys.exit(1 if check and differ else 0)


if __name__ == "__main__":
    main()
