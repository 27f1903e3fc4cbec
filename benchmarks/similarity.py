"""What motivates the method (CompGS Fig. 2): how alike neighbouring splats of plain 3DGS are, a table and a figure.

    python benchmarks/similarity.py ../shared/splats/playbot_lod3.ply
    python benchmarks/similarity.py ../shared/scenes/plush_480 -r 2 --steps 4000

Of a .ply file of splats, or of a scene, which is first trained by `compgs train --method 3dgs` (the run stays in
--runs, and is the one of `ablation.py components` if its settings are the same). Measured are the splats' attributes,
never their positions: the mean cosine similarity of each splat to its 20 nearest neighbours, beside that to 20 random
splats; and how much of each attribute's variance is left when neighbours predict it. Writes similarity_NAME.md, .json
and .png to --output.
"""

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from ablation import ROOT, STUDIES, common_arguments, git_commit, run_compgs, run_variant, train_command
from ablation_figures import check_matplotlib
from similarity_figures import figure
from similarity_measures import NEIGHBOURS, Measured, Similarity, measure

from compgs.errors import SplatFileError
from compgs.formats import read_ply
from compgs.outputs import write_bytes, write_json

PLAIN_3DGS = next(variant for variant in STUDIES["components"] if variant.name == "3dgs")

EXPLANATION = f"""\
The paper's figure shows "the average cosine distances between a 3D Gaussian and its {NEIGHBOURS} neighbors with minimal
Euclidean distance". It does not say of which numbers. Here positions only say who is a neighbour; compared are:

- *scales*: logarithms of the three standard deviations, largest first;
- *orientation*: where to a splat is longer than it is large (the logarithm of its covariance without its trace), which
  depends neither on the sign of the quaternion nor on the order of the axes;
- *opacity*, from 0 to 1; *color*: the harmonic of degree 0; *harmonics*: those of higher degrees, if there are any.

Each attribute is centred over the scene, so that what all splats have in common counts for nothing: random pairs are
then at about 0, where two vectors have nothing to do with each other. Together every attribute weighs the same. The
last row is the plain reading of the paper: all stored numbers but the position, not centred; random pairs are
alike there, too, so that the high value of neighbours says less than it seems to.

- **cosine similarity**: 1 less the paper's cosine distance, mean over the {NEIGHBOURS} partners and over all splats.
  A single number has no direction, so opacity has none.
- **variance left**: what remains of an attribute's variance when each splat is predicted by the mean of its
  {NEIGHBOURS} partners. This is what the method lives on: the less is left, the less is to be sent. Partners that say
  nothing leave {100 * (1 + 1 / NEIGHBOURS):.0f} %.

Neighbours are looked up on both sides here, where a decoder would know only some of them: this is a property of the
splats, not the gain of a codec. Splats that density control made as copies of one another are neighbours, too.
"""


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("source", type=Path, metavar="SCENE|SPLATS.ply")
    parser.add_argument("--name", help="default: that of the file or of the scene")
    parser.add_argument("--note", default="", help="about the splats, for the table: origin, license")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "results")
    training = parser.add_argument_group("for a scene")
    training.add_argument("--runs", type=Path, default=ROOT / "runs" / "ablation", help="for the training")
    training.add_argument("-r", "--downscale", type=int, default=1)
    training.add_argument("--steps", type=int, help="default: the preset's")
    training.add_argument("--preset", help="default: the default one")
    training.add_argument("--seed", type=int, default=0)
    training.add_argument("--threads", type=int)
    return parser.parse_args(arguments)


def trained_splats(options: argparse.Namespace) -> Path:
    """The .ply file of a scene, which is trained unless it has been. Raises SystemExit if the training does."""
    scene = options.source.resolve()
    folder = options.runs / "similarity" / f"{scene.name}_3dgs_seed{options.seed}"
    # What all variants of an ablation share, with nothing set and nothing else evaluated.
    common = common_arguments(argparse.Namespace(**vars(options), set=[], lpips=False, flip=False))
    command = train_command(PLAIN_3DGS, scene, folder, common, options.seed)
    record = run_variant(PLAIN_3DGS, command, folder, options.seed, run_compgs)
    # A training of the same settings may lie in another study's folder.
    trained = record["command"][record["command"].index("-o") + 1]
    return Path(trained) / record["results"]["file"]


def table(rows: Sequence[Similarity]) -> str:
    """Markdown."""
    lines = [
        f"| attribute | numbers a splat | cosine similarity to {NEIGHBOURS} neighbours | to {NEIGHBOURS} random splats "
        "| variance left, predicted by neighbours | by random splats |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        cosines = ["none" if c is None else f"{round(c, 2) + 0.0:.2f}" for c in (row.neighbours, row.random)]
        left = ["" if share is None else f"{100 * share:.0f} %" for share in (row.left, row.left_random)]
        lines.append("| " + " | ".join([row.attribute, str(row.numbers), *cosines, *left]) + " |")
    return "\n".join(lines)


def report(name: str, measured: Measured, command: str, note: str) -> str:
    """The Markdown file."""
    parts = [
        f"# Local similarity of splats: {name}",
        f"`{command}`",
        f"{measured.splats:,} splats, commit {git_commit()}. {note}".rstrip(),
        f"All attributes together, **{100 * measured.beyond_random:.0f} %** of the splats are more like their "
        f"{NEIGHBOURS} neighbours than 99 % of the splats are like {NEIGHBOURS} random ones.",
        table(measured.rows),
        f"![local similarity](similarity_{name}.png)",
        "## What is measured",
        EXPLANATION.rstrip(),
    ]
    return "\n\n".join(parts) + "\n"


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    check_matplotlib()
    file = trained_splats(options) if options.source.is_dir() else options.source
    name = options.name or (options.source.resolve().name if options.source.is_dir() else file.stem)
    try:
        measured = measure(read_ply(file))
    except SplatFileError as reason:
        raise SystemExit(str(reason)) from reason
    given = sys.argv[1:] if arguments is None else arguments
    text = report(name, measured, f"python benchmarks/similarity.py {shlex.join(given)}", options.note)
    stem = options.output / f"similarity_{name}"
    write_bytes(stem.with_name(stem.name + ".md"), text.encode())
    write_json(stem.with_name(stem.name + ".json"), {**measured.to_dict(), "commit": git_commit()})
    write_bytes(stem.with_name(stem.name + ".png"), figure(name, measured))
    print(text)


if __name__ == "__main__":
    main()
