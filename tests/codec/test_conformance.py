"""The conformance set, asked of every decoder that is here; and that its judge notices what is wrong."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SET = ROOT / "conformance"
sys.path.append(str(SET))
import run  # noqa: E402

PACKAGE = [sys.executable, str(SET / "decoders" / "package.py")]


def asked(command: list[str], *options: str) -> tuple[int, str]:
    """Status and output of the judge."""
    judge = [sys.executable, str(SET / "run.py"), *options, *command]
    result = subprocess.run(judge, capture_output=True, text=True, check=False, cwd=ROOT)
    return result.returncode, result.stdout + result.stderr


def test_the_package_conforms() -> None:
    status, output = asked(PACKAGE, "--seconds", "600")  # the first job compiles the kernels
    assert status == 0, output
    assert output.endswith("conforms\n") and "not offered" not in output
    for kind in run.KINDS:
        assert f"{kind}: " in output


def test_the_set_is_small_and_whole() -> None:
    files = [path for path in SET.rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    assert sum(path.stat().st_size for path in files) < 2 << 20
    for kind in ("refused", "unusual"):
        listed = json.loads((SET / f"{kind}.json").read_text(encoding="utf-8"))
        assert sorted(path.stem for path in (SET / kind).glob("*.cgs")) == sorted(listed)
    errors = {
        case["error"] for case in json.loads((SET / "refused.json").read_text(encoding="utf-8")).values()
    }
    assert errors == {"NotACompGSFile", "UnsupportedVersion", "TruncatedSection", "CorruptSection"}


def test_the_readme_counts_what_is_there() -> None:
    text = (SET / "README.md").read_text(encoding="utf-8")
    counts = dict.fromkeys(run.KINDS, 0)
    for job in run.jobs():
        counts[job.kind] += 1
    for kind, count in counts.items():
        (row,) = [line for line in text.splitlines() if line.startswith(f"| `{kind}` |")]
        assert f": {count}, with" in row


# Decoders that are wrong in one way each: what they answer, and what the judge says of it.
WRONG = {
    "accepts everything": ("print('ok', flush=True)", "unusual", "coordinates is not there"),
    "refuses everything": ("print('CorruptSection', flush=True)", "unusual", "answers 'CorruptSection'"),
    "has another reason": ("print('TruncatedSection', flush=True)", "refuse", "expected CorruptSection"),
    "crashes": ("sys.exit(3)", "unusual", "crashed"),
    "hangs": ("time.sleep(60)", "render", "took longer than 1 s"),
}


@pytest.mark.parametrize("name", WRONG)
def test_the_judge_finds_a_decoder_that(name: str, tmp_path: Path) -> None:
    answer, kind, message = WRONG[name]
    program = tmp_path / "wrong.py"
    program.write_text(f"import sys, time\nfor line in sys.stdin:\n    {answer}\n", encoding="utf-8")
    status, output = asked([sys.executable, str(program)], "--only", kind, "--seconds", "1")
    assert status == 1 and message in output, output


def test_one_wrong_bit_of_an_array_is_found(tmp_path: Path) -> None:
    job = next(job for job in run.jobs() if job.kind == "unusual")
    with run.Decoder(PACKAGE, 600.0) as decoder:
        assert decoder.problem_of(job) == ""
        decoder._ask("\t".join(("decode", job.fields[1], str(tmp_path))))
    assert job.check("ok", tmp_path) == ""
    for array in ("mask", "heads", "latents1", "symbols3"):
        data = bytearray((tmp_path / array).read_bytes())
        data[-1] ^= 1
        (tmp_path / array).write_bytes(data)
        assert job.check("ok", tmp_path) == f"{array} has another SHA-256"
        data[-1] ^= 1
        (tmp_path / array).write_bytes(data)


def test_a_picture_that_is_a_little_off_passes_and_another_does_not(tmp_path: Path) -> None:
    job = next(job for job in run.jobs() if job.kind == "render")
    width, height, pixels = run.read_png(SET / "pictures" / f"{job.name}.png")
    for difference, passes in ((0, True), (1, True), (3, False)):
        moved = bytes(p - difference if p > 127 else p + difference for p in pixels)
        (tmp_path / "picture.ppm").write_bytes(b"P6\n%d %d\n255\n" % (width, height) + moved)
        assert (job.check("ok", tmp_path) == "") == passes
    (tmp_path / "picture.ppm").write_bytes(b"P6\n%d %d\n255\n" % (height, width) + pixels)
    assert "picture.ppm begins with" in job.check("ok", tmp_path)


@pytest.mark.parametrize("path", sorted((SET / "pictures").glob("*.png")), ids=lambda path: path.stem)
def test_pictures_are_read_as_another_library_reads_them(path: Path) -> None:
    image = pytest.importorskip("PIL.Image").open(path)
    assert run.read_png(path) == (*image.size, image.tobytes())
