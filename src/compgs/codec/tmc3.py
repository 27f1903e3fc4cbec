"""Anchor positions by G-PCC, as in the paper (CompGS Sec. 3.4), where its test model TMC13 is at hand.

    payload = origin (three little-endian int32), bitstream of TMC13

`tmc3` is MPEG's reference encoder; it is packaged nowhere and is found on PATH. It is here for fidelity to
the paper: octree.py takes fewer bytes, and needs no other program.

A file may come from anyone, and must not decide which programs run here: to decode, `tmc3` is run only by those who
asked for it, with the environment variable COMPGS_TMC3=1 or `--tmc3`.
"""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from compgs.codec.octree import MAXIMUM_ANCHORS
from compgs.errors import CorruptSection, MissingDependency, NotEncodable
from compgs.ordering.order import canonical_order

__all__ = ["ASKED_BY", "PROGRAM", "decode_positions_tmc3", "encode_positions_tmc3", "find_program"]

PROGRAM = "tmc3"
ASKED_BY = "COMPGS_TMC3"  # environment variable; 1: files may have their positions decoded by the program
TIME_LIMIT = 600  # seconds; TMC13 takes about two per million anchors

# Lossless octree without planar mode, isolated points coded directly; the authors' choice.
ENCODER_OPTIONS = (
    "--mode=0",
    "--trisoupNodeSizeLog2=0",
    "--mergeDuplicatedPoints=0",
    "--neighbourAvailBoundaryLog2=8",
    "--intra_pred_max_node_size_log2=3",
    "--positionQuantizationScale=1",
    "--inferredDirectCodingMode=3",
    "--maxNumQtBtBeforeOt=2",
    "--minQtbtSizeLog2=0",
    "--planarEnabled=0",
    "--planarModeIdcmUse=0",
    "--cabac_bypass_stream_enabled_flag=1",
)
DECODER_OPTIONS = ("--mode=1", "--outputBinaryPly=1")

_PLY_TYPES = {
    **{name: "i1" for name in ("char", "int8")},
    **{name: "u1" for name in ("uchar", "uint8")},
    **{name: "<i2" for name in ("short", "int16")},
    **{name: "<u2" for name in ("ushort", "uint16")},
    **{name: "<i4" for name in ("int", "int32")},
    **{name: "<u4" for name in ("uint", "uint32")},
    **{name: "<f4" for name in ("float", "float32")},
    **{name: "<f8" for name in ("double", "float64")},
}


def encode_positions_tmc3(coordinates: NDArray[np.int32]) -> bytes:
    """[N, 3] voxel coordinates, in any order, N >= 1 -> payload.

    Raises MissingDependency without `tmc3`, NotEncodable for what octree.py refuses too or if `tmc3` fails.
    """
    program = find_program()
    if not 1 <= len(coordinates) <= MAXIMUM_ANCHORS:
        raise NotEncodable(f"anchor positions: {len(coordinates)} anchors, expected 1 to {MAXIMUM_ANCHORS}")
    ordered = coordinates[canonical_order(coordinates)].astype(np.int64)  # refuses duplicates and wide clouds
    origin = ordered.min(axis=0)
    with tempfile.TemporaryDirectory(prefix="compgs-") as folder:
        cloud, stream = Path(folder, "anchors.ply"), Path(folder, "anchors.bin")
        _write_ply(cloud, (ordered - origin).astype("<f4"))  # below 2**21: exact in float32
        problem = _run(
            [program, *ENCODER_OPTIONS, f"--uncompressedDataPath={cloud}", f"--compressedStreamPath={stream}"]
        )
        if problem or not stream.is_file():
            raise NotEncodable(
                f"anchor positions: {PROGRAM} wrote no bitstream: {problem or 'it gave no reason'}"
            )
        return origin.astype("<i4").tobytes() + stream.read_bytes()


def decode_positions_tmc3(data: bytes, count: int) -> NDArray[np.int32]:
    """Payload of `count` anchors -> [N, 3] voxel coordinates, in canonical order (ordering/order.py).

    TMC13 returns its points in an order of its own. Raises MissingDependency without `tmc3`, or where nobody asked for
    it, CorruptSection if what it decodes is not `count` distinct voxels. How `tmc3` behaves on damaged data is beyond
    this package: it runs in a process of its own, with a time limit.
    """
    if os.environ.get(ASKED_BY) != "1":
        raise MissingDependency(
            f"anchor positions: they are coded by G-PCC, and the program {PROGRAM}, which decodes them, is run only "
            f"when that is asked for: give --tmc3, or set {ASKED_BY}=1; else ask for the file with positions of the "
            "octree coder"
        )
    program = find_program()
    if len(data) <= 12 or not 1 <= count <= MAXIMUM_ANCHORS:
        raise CorruptSection(f"anchor positions: {len(data)} bytes of G-PCC for {count} anchors")
    origin = np.frombuffer(data, "<i4", 3).astype(np.int64)
    with tempfile.TemporaryDirectory(prefix="compgs-") as folder:
        cloud, stream = Path(folder, "anchors.ply"), Path(folder, "anchors.bin")
        stream.write_bytes(data[12:])
        problem = _run(
            [
                program,
                *DECODER_OPTIONS,
                f"--compressedStreamPath={stream}",
                f"--reconstructedDataPath={cloud}",
            ]
        )
        if problem or not cloud.is_file():
            raise CorruptSection(
                f"anchor positions: {PROGRAM} decoded nothing: {problem or 'it gave no reason'}"
            )
        points = _read_ply(cloud, count)
    if (
        not np.isfinite(points).all()
        or (points != np.rint(points)).any()
        or (np.abs(points) >= 1 << 31).any()
    ):
        raise CorruptSection(f"anchor positions: {PROGRAM} decoded points that are not voxels")
    coordinates = points.astype(np.int64) + origin
    if (coordinates != coordinates.astype(np.int32)).any():
        raise CorruptSection("anchor positions: coordinates beyond 32 bits")
    voxels = coordinates.astype(np.int32)
    try:
        return voxels[canonical_order(voxels)]
    except NotEncodable as error:
        raise CorruptSection(f"{error} (decoded by {PROGRAM})") from error


def find_program() -> str:
    """Path of `tmc3`. Raises MissingDependency."""
    program = shutil.which(PROGRAM)
    # Windows looks into the current folder first, whatever PATH says, and what lies there may have come with a scene.
    folders = [os.path.abspath(folder) for folder in os.environ.get("PATH", "").split(os.pathsep) if folder]
    if program is None or os.path.dirname(os.path.abspath(program)) not in folders:
        raise MissingDependency(
            f"geometry by G-PCC: no program {PROGRAM!r} on PATH; build github.com/MPEGGroup/mpeg-pcc-tmc13 "
            "and put it there, or use the octree coder, which is the default"
        )
    return program


def _run(command: list[str]) -> str:
    """Run a program; the reason why it failed, empty if it did not."""
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=TIME_LIMIT)
    except subprocess.TimeoutExpired:
        return f"still running after {TIME_LIMIT} s"
    except OSError as error:
        return f"it does not start: {error.strerror}"
    if done.returncode == 0:
        return ""
    last = (done.stderr or done.stdout).decode(errors="replace").strip().splitlines()[-1:]
    return f"exit status {done.returncode}" + "".join(f", {line}" for line in last)


def _write_ply(path: Path, points: NDArray[np.float32]) -> None:
    """[N, 3] float32 -> binary PLY."""
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
        "property float x\nproperty float y\nproperty float z\nend_header\n"
    )
    path.write_bytes(header.encode() + np.ascontiguousarray(points, "<f4").tobytes())


def _read_ply(path: Path, count: int) -> NDArray[np.float64]:
    """[count, 3] x, y, z of the vertices of a PLY file, ASCII or binary, with other properties or without."""
    data = path.read_bytes()
    head, mark, body = data.partition(b"end_header\n")
    words = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    form = next((w[1] for w in words if w[:1] == ["format"] and len(w) > 1), "")
    elements = [w for w in words if w[:1] == ["element"]]
    properties = [(w[2], _PLY_TYPES.get(w[1], "")) for w in words if w[:1] == ["property"] and len(w) == 3]
    names = [name for name, _ in properties]
    known = mark and all(kind for _, kind in properties) and {"x", "y", "z"} <= set(names)
    if not known or len(set(names)) < len(names) or elements[:1] != [["element", "vertex", str(count)]]:
        raise CorruptSection(f"anchor positions: {PROGRAM} decoded no cloud of {count} points")
    short = CorruptSection(f"anchor positions: {PROGRAM} decoded fewer than {count} points")
    if form == "ascii":
        values = body.split()
        if len(values) < count * len(names):
            raise short
        try:
            table = np.array(values[: count * len(names)], np.float64).reshape(count, len(names))
        except ValueError as error:
            raise CorruptSection(
                f"anchor positions: {PROGRAM} decoded something else than numbers"
            ) from error
        return table[:, [names.index(axis) for axis in "xyz"]]
    layout = np.dtype(properties)
    if form != "binary_little_endian" or len(body) < count * layout.itemsize:
        raise short
    vertices = np.frombuffer(body, layout, count)
    return np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
