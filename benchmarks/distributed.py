"""What it costs that several processes hold one model: measured with gloo here, modelled for eight GPUs.

    python benchmarks/distributed.py [--anchors 100000 --anchors 1000000] [--repeats 5] [--output docs/results]

Measured: two processes on this machine, joined by gloo over its own network, and the models of a default training with
made-up gradients. Times are of the processor, of one of the two processes, all its threads together.

Modelled, not measured: bytes over bandwidths. A ring of W ranks sends 2 (W - 1) / W of the gradient's bytes from each
rank.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import compgs  # noqa: F401  # before torch: its threads must not spin

ANCHORS = (100_000, 1_000_000)
RANKS = 8
# Bytes a second that a ring gets in one direction from each rank, and who says so.
BANDWIDTHS = {
    "NVLink 4, 8 H100 or H200": 370e9,  # NCCL's developers, nccl-tests discussion 212: 450 less its protocol
    "PCIe 5 x16": 0.8 * 64e9,  # line rate of the standard, one direction, less a fifth as above
    "100 Gbit/s Ethernet": 0.8 * 12.5e9,  # the same
}
VIEW_MS = (5, 20, 80)  # of a GPU, for one view of a step: assumed, for want of a GPU


def measured(work: Callable[[], Any], repeats: int) -> dict[str, float]:
    """Mean processor and wall seconds, after one run that does not count."""
    work()
    processor, wall = time.process_time(), time.perf_counter()
    for _ in range(repeats):
        work()
    return {
        "processor": (time.process_time() - processor) / repeats,
        "wall": (time.perf_counter() - wall) / repeats,
    }


def of_one_rank(rank: int, anchors: int, repeats: int, folder: Path) -> dict[str, Any]:
    import torch
    import torch.distributed as dist

    from compgs.config import Config
    from compgs.trained_model import TrainedModel
    from compgs.training.run.distributed import check_identical, on_any_rank, sum_gradients, summed_over_ranks
    from compgs.training.structure.control import AdaptiveControl, make_schedule

    dist.init_process_group("gloo", init_method=f"file://{folder}/meeting", rank=rank, world_size=2)
    config = Config()
    torch.manual_seed(0)  # the same model on both
    coordinates = torch.arange(anchors, dtype=torch.int32)[:, None].repeat(1, 3)
    model = TrainedModel(config, coordinates, 0.01, 1.0, (0.0, 0.0, 0.0))
    for parameter in model.parameters():
        parameter.grad = torch.randn_like(parameter)
    parameters = list(model.parameters())
    control = AdaptiveControl(
        config,
        make_schedule(config.control, 30_000, 200),
        (anchors, config.model.coupled_primitives),
        torch.device("cpu"),
    )
    gradient_bytes = sum(4 * p.numel() for p in parameters)
    statistics = AdaptiveControl.STATISTICS

    def gather() -> None:
        with summed_over_ranks(control, statistics):
            pass

    return {
        "anchors": anchors,
        "gradient_bytes": gradient_bytes,
        "statistics_bytes": sum(4 * getattr(control, name).numel() for name in statistics),
        "flags": measured(lambda: on_any_rank(False, True), 100),
        "gradients": measured(lambda: sum_gradients(parameters), repeats),
        "statistics": measured(gather, repeats),
        "hash": measured(lambda: check_identical(0, model.state_dict()), 2),
    }


def of_two(anchors: int, repeats: int) -> dict[str, Any]:
    """What rank 0 found."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "GLOO_SOCKET_IFNAME": os.environ.get("GLOO_SOCKET_IFNAME", "lo")}
        command = [
            sys.executable,
            __file__,
            "--folder",
            folder,
            "--repeats",
            str(repeats),
            "--anchors",
            str(anchors),
        ]
        processes = [
            subprocess.Popen(
                [*command, "--rank", str(rank)], stdout=subprocess.PIPE, text=True, env=environment
            )
            for rank in range(2)
        ]
        said = [process.communicate()[0] for process in processes]
        if any(process.returncode for process in processes):
            raise SystemExit(f"{anchors} anchors: a process failed")
        return json.loads(said[0])


def report_measured(rows: list[dict[str, Any]]) -> None:
    print("| | " + " | ".join(f"{row['anchors']:,} anchors" for row in rows) + " |")
    print("|---|" + "---|" * len(rows))
    for name, key in (
        ("gradients, MB a step", "gradient_bytes"),
        ("statistics, MB a control", "statistics_bytes"),
    ):
        print(f"| {name} |", *(f"{row[key] / 1e6:.1f} |" for row in rows))
    for name, key in (
        ("sum of gradients, every step", "gradients"),
        ("a flag, three times a step", "flags"),
        ("sum of statistics, every control", "statistics"),
        ("hash and comparison, every control", "hash"),
    ):
        cells = (f"{1e3 * row[key]['processor']:.3g} ({1e3 * row[key]['wall']:.3g}) |" for row in rows)
        print(f"| {name}, processor ms (waiting) |", *cells)


def modelled(row: dict[str, Any], bandwidth: float, view_ms: float) -> tuple[float, float]:
    """Milliseconds that the reduction and the flags of a step take, and the speed of the GPUs, a view each, over as
    many times that of one with a view a step.
    """
    flags = 3e3 * row["flags"]["processor"]
    reduction = 1e3 * 2 * (RANKS - 1) / RANKS * row["gradient_bytes"] / bandwidth + flags
    return reduction, view_ms / (view_ms + reduction)


def report_model(rows: list[dict[str, Any]]) -> None:
    print(f"\nModel: {RANKS} GPUs, a view each\n")
    print("| | | added to a step |", *(f"{ms} ms a view |" for ms in VIEW_MS))
    print("|---|---|---|" + "---|" * len(VIEW_MS))
    for row in rows:
        for name, bandwidth in BANDWIDTHS.items():
            found = [modelled(row, bandwidth, ms) for ms in VIEW_MS]
            shares = " | ".join(f"{100 * share:.0f} %" for _, share in found)
            print(f"| {row['anchors']:,} anchors | {name} | {found[0][0]:.2g} ms | {shares} |")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--anchors", type=int, action="append", default=[])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--output", type=Path, help="folder for distributed.json")
    parser.add_argument("--rank", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.folder:
        print(json.dumps(of_one_rank(options.rank, options.anchors[0], options.repeats, options.folder)))
        return
    rows = [of_two(anchors, options.repeats) for anchors in options.anchors or ANCHORS]
    report_measured(rows)
    report_model(rows)
    if options.output:
        text = json.dumps(rows, indent=2) + "\n"
        (options.output / "distributed.json").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
