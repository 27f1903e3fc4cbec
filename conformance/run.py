"""Tests a decoder of .cgs files against this set. Needs nothing but Python 3.10 or later.

    python conformance/run.py [--only KIND] [--seconds 60] COMMAND ...

COMMAND starts the decoder. It reads jobs from its standard input, a line each, fields separated by tabs, and answers
each with a line on its standard output. README.md says what the jobs are, and what the decoder writes.
"""

import argparse
import contextlib
import hashlib
import json
import queue
import re
import struct
import subprocess
import sys
import tempfile
import threading
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parent
GOLDEN = HERE.parent / "tests" / "golden"
KINDS = ("decode", "unusual", "prefix", "refuse", "predict", "render")
NOT_OFFERED = "not offered"

# Of each Gaussian: how many numbers, and by how much they may differ (docs/bitstream_prediction.md, "Precision").
FIELDS = {"mean": 3, "scales": 3, "quaternion": 4, "opacity": 1, "color": 3}
TOLERANCE = 1e-4
LEAST_PSNR = 45.0  # dB, of a picture


@dataclass(frozen=True)
class Job:
    """What the decoder is asked, and a check of its answer: a problem, or nothing."""

    kind: str
    name: str
    fields: tuple[str, ...]  # action, file and what follows the folder
    check: Callable[[str, Path], str]


def main() -> int:
    parser = argparse.ArgumentParser(description="Tests a decoder of .cgs files.")
    parser.add_argument("--only", choices=KINDS, action="append", help="jobs of this kind alone")
    parser.add_argument(
        "--seconds", type=float, default=60.0, help="that a job may take (default: %(default)g)"
    )
    parser.add_argument("command", nargs=argparse.REMAINDER, help="the decoder, and its arguments")
    options = parser.parse_args()
    if not options.command:
        parser.error(
            "COMMAND is missing: the decoder to test, for example: node conformance/decoders/web.mjs"
        )
    counts = {kind: [0, 0, 0] for kind in options.only or KINDS}  # passed, failed, not offered
    with Decoder(options.command, options.seconds) as decoder:
        for job in jobs():
            if job.kind not in counts:
                continue
            problem = decoder.problem_of(job)
            outcome = 2 if problem == NOT_OFFERED else int(bool(problem))
            counts[job.kind][outcome] += 1
            if outcome == 1:
                print(f"FAILED {job.kind} {job.name}: {problem}", flush=True)
    for kind, (passed, failed, without) in counts.items():
        print(
            f"{kind}: {passed} of {passed + failed} passed" + (f", {without} not offered" if without else "")
        )
    failures = sum(failed for _, failed, _ in counts.values())
    print("conforms" if not failures else f"{failures} failures")
    return int(failures > 0)


class Decoder:
    """The program that is tested; started again after a crash or a hang."""

    def __init__(self, command: list[str], seconds: float) -> None:
        self.command, self.seconds = command, seconds
        self.process: subprocess.Popen | None = None

    def __enter__(self) -> "Decoder":
        return self

    def __exit__(self, *_: object) -> None:
        self._stop()

    def problem_of(self, job: Job) -> str:
        with tempfile.TemporaryDirectory() as folder:
            action, file, *more = job.fields
            answer = self._ask("\t".join((action, file, folder, *more)))
            if answer in (NOT_OFFERED, "crashed") or answer.startswith("took"):
                return answer
            return job.check(answer, Path(folder))

    def _ask(self, line: str) -> str:
        if self.process is None:
            self._start()
        assert self.process is not None and self.process.stdin is not None
        try:
            self.process.stdin.write(line + "\n")
            self.process.stdin.flush()
            answer = self.answers.get(timeout=self.seconds)
        except queue.Empty:
            self._stop()
            return f"took longer than {self.seconds:g} s"
        except OSError:
            answer = None
        if answer is None:
            self._stop()
            return "crashed"
        return answer.strip()

    def _start(self) -> None:
        process = subprocess.Popen(
            self.command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, encoding="utf-8"
        )
        answers: queue.Queue[str | None] = queue.Queue()

        def read() -> None:
            for line in process.stdout or ():
                answers.put(line)
            answers.put(None)

        threading.Thread(target=read, daemon=True).start()
        self.process, self.answers = process, answers

    def _stop(self) -> None:
        if self.process is not None:
            with contextlib.suppress(OSError):
                self.process.stdin and self.process.stdin.close()
            self.process.kill()
            self.process.wait()
        self.process = None


# ---- jobs


def jobs() -> Iterator[Job]:
    for name, pinned in _json(GOLDEN / "hashes.json").items():
        yield _decode("decode", name, GOLDEN / f"{name}.cgs", pinned)
    for name, pinned in _json(HERE / "unusual.json").items():
        yield _decode("unusual", name, HERE / "unusual" / f"{name}.cgs", pinned)
    for name, sizes in _json(GOLDEN / "prefixes.json").items():
        for size, pinned in sizes.items():
            yield _decode("prefix", f"{name}, {size} bytes", GOLDEN / f"{name}.cgs", pinned, size)
    for name, case in _json(HERE / "refused.json").items():
        fields = [
            "decode",
            str(HERE / "refused" / f"{name}.cgs"),
            *([str(case["bytes"])] if "bytes" in case else []),
        ]
        yield Job("refuse", name, tuple(fields), _refusal(case))
    for name, pinned in _json(GOLDEN / "gaussians.json").items():
        center = (repr(value) for value in pinned["camera_center"])
        yield Job("predict", name, ("predict", str(GOLDEN / f"{name}.cgs"), *center), _prediction(pinned))
    for name, camera in _json(HERE / "pictures.json").items():
        pose = [value for row in camera["world_to_camera"][:3] for value in row]
        numbers = (
            repr(v) for v in (*pose, *(camera[k] for k in ("fx", "fy", "cx", "cy", "width", "height")))
        )
        file = GOLDEN / f"{camera['file']}.cgs"
        yield Job(
            "render", name, ("render", str(file), *numbers), _picture(HERE / "pictures" / f"{name}.png")
        )


def _json(path: Path) -> dict:
    return json.loads(path.read_text(encoding="utf-8"))


def _decode(kind: str, name: str, file: Path, pinned: dict[str, str], size: str | None = None) -> Job:
    arrays = {_file_name(array): value for array, value in pinned.items() if array not in ("file", "why")}

    def check(answer: str, folder: Path) -> str:
        if answer != "ok":
            return f"answers {answer!r}, expected 'ok'"
        for array, value in arrays.items():
            path = folder / array
            if not path.is_file():
                return f"{array} is not there"
            if hashlib.sha256(path.read_bytes()).hexdigest() != value:
                return f"{array} has another SHA-256"
        return ""

    fields = ("decode", str(file)) if size is None else ("decode", str(file), size)
    return Job(kind, name, fields, check)


def _file_name(array: str) -> str:
    """`group 0, side: symbols` is in `symbols0`."""
    group = re.fullmatch(r"group (\d+), [a-z ]+: (symbols|latents)", array)
    return f"{group[2]}{group[1]}" if group else array


def _refusal(case: dict) -> Callable[[str, Path], str]:
    def check(answer: str, folder: Path) -> str:
        return (
            "" if answer == case["error"] else f"{case['why']}: answers {answer!r}, expected {case['error']}"
        )

    return check


def _prediction(pinned: dict) -> Callable[[str, Path], str]:
    width = sum(FIELDS.values())

    def check(answer: str, folder: Path) -> str:
        if answer != "ok":
            return f"answers {answer!r}, expected 'ok'"
        data = (folder / "gaussians").read_bytes()
        values = struct.unpack(f"<{len(data) // 4}f", data)
        rows = [values[i : i + width] for i in range(0, len(values), width)]
        if len(rows) != pinned["count"]:
            return f"{len(rows)} Gaussians, expected {pinned['count']}"
        at = 0
        for name, columns in FIELDS.items():
            found = [row[at : at + columns] for row in rows]
            at += columns
            # Numbers near 1 and large ones alike: a share of what is largest among them.
            for gaussian, expected in zip(found, pinned["first"], strict=False):
                exact = _numbers(expected[name])
                if any(
                    abs(a - b) > TOLERANCE * max(1.0, *map(abs, exact))
                    for a, b in zip(gaussian, exact, strict=True)
                ):
                    return f"{name} of anchor {expected['anchor']}, slot {expected['slot']} is {gaussian}, not {exact}"
            for i, total in enumerate(_numbers(pinned["sums"][name])):
                sizes = sum(abs(row[i]) for row in found)
                if abs(sum(row[i] for row in found) - total) > TOLERANCE * max(len(rows), sizes):
                    return f"the sum of {name}, {i} is {sum(row[i] for row in found)}, expected {total}"
        return ""

    return check


def _numbers(value: float | list[float]) -> list[float]:
    return value if isinstance(value, list) else [value]


def _picture(reference: Path) -> Callable[[str, Path], str]:
    def check(answer: str, folder: Path) -> str:
        if answer != "ok":
            return f"answers {answer!r}, expected 'ok'"
        width, height, expected = read_png(reference)
        data = (folder / "picture.ppm").read_bytes()
        head = re.match(rb"P6\s+(\d+)\s+(\d+)\s+255\s", data)
        if head is None or (int(head[1]), int(head[2])) != (width, height):
            return f"picture.ppm begins with {data[:15]!r}, expected P6 {width} {height} 255"
        found = data[head.end() :]
        if len(found) != len(expected):
            return f"{len(found)} bytes of pixels, expected {len(expected)}"
        error = sum((a - b) ** 2 for a, b in zip(found, expected, strict=True)) / len(expected)
        # 10 log10(255^2 / error) is at least LEAST_PSNR.
        most = 255**2 / 10 ** (LEAST_PSNR / 10)
        return "" if error <= most else f"the mean squared error is {error:.3f}, expected up to {most:.3f}"

    return check


def read_png(path: Path) -> tuple[int, int, bytes]:
    """Width, height and RGB pixels of a PNG of 8 bits a channel that is not interlaced."""
    data = path.read_bytes()
    at, packed, width, height = 8, b"", 0, 0
    while at < len(data):
        (length,) = struct.unpack_from(">I", data, at)
        kind, chunk = data[at + 4 : at + 8], data[at + 8 : at + 8 + length]
        if kind == b"IHDR":
            width, height, depth, color = struct.unpack_from(">IIBB", chunk)
            if (depth, color) != (8, 2):
                raise ValueError(f"{path}: not RGB of 8 bits")
        elif kind == b"IDAT":
            packed += chunk
        at += 12 + length
    raw, stride, rows = zlib.decompress(packed), 3 * width, [bytes(3 * width)]
    for y in range(height):
        line = raw[y * (stride + 1) : (y + 1) * (stride + 1)]
        rows.append(_unfiltered(line[0], line[1:], rows[-1]))
    return width, height, b"".join(rows[1:])


def _unfiltered(kind: int, line: bytes, above: bytes) -> bytes:
    out = bytearray(line)
    for i in range(len(out)):
        a, b, c = (out[i - 3], above[i], above[i - 3]) if i >= 3 else (0, above[i], 0)
        nearest = min((a, b, c), key=lambda v: abs(a + b - c - v))  # the first of equal ones, as Paeth has it
        out[i] = (out[i] + (0, a, b, (a + b) // 2, nearest)[kind]) & 255
    return bytes(out)


if __name__ == "__main__":
    sys.exit(main())
