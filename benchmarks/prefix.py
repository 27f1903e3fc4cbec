"""Quality over bytes received: what a viewer shows while a file arrives, and what the division into ranges costs.

    python benchmarks/prefix.py FILE.cgs SCENE [-r 2] [-o docs/results/prefix_NAME]

Every row is the beginning of the file up to the end of a range of octree levels, decoded as `compgs decode --prefix`
does, and rendered at the scene's held-out views.
"""

import argparse
from pathlib import Path
from statistics import fmean
from typing import Any

from ablation import git_commit, machine

from compgs import metrics
from compgs.codec.decoder import decode
from compgs.codec.reader import file_info, read_content
from compgs.codec.writer import write_content
from compgs.outputs import write_bytes, write_json
from compgs.render import render
from compgs.scene import load_scene


def measure(file: Path, scene_path: Path, downscale: int) -> dict[str, Any]:
    """Rows by range, and the bytes of the same content in one range."""
    data = file.read_bytes()
    info = file_info(data)
    scene = load_scene(scene_path, downscale=downscale)
    rows = []
    for part in info.ranges:
        model = decode(file, prefix=part.bytes)
        images = [metrics.to_8bit(render(model, view.camera).image) for view in scene.test_views]
        pairs = list(zip(images, (view.image for view in scene.test_views), strict=True))
        rows.append(
            {
                "level": part.level,
                "bytes": part.bytes,
                "share": part.bytes / info.bytes,
                "anchors": part.anchors,
                "psnr": fmean(metrics.psnr(a, b) for a, b in pairs),
                "ssim": fmean(metrics.ssim(a, b) for a, b in pairs),
            }
        )
    undivided = len(write_content(read_content(data), levels=[info.ranges[-1].level]))
    return {
        "file": file.name,
        "scene": scene.name,
        "views": len(scene.test_views),
        "bytes": info.bytes,
        "undivided_bytes": undivided,
        "rows": rows,
        "commit": git_commit(),
        "machine": machine(),
    }


def report(results: dict[str, Any], command: str) -> str:
    lines = [
        f"# Quality over bytes received: {results['file']}",
        "",
        f"`{command}`",
        "",
        f"{results['views']} held-out views of {results['scene']}; commit {results['commit']}.",
        "",
        "| Up to octree level | Bytes received | Share of the file | Anchors | PSNR (dB) | SSIM |",
        "|---|---|---|---|---|---|",
    ]
    for row in results["rows"]:
        lines.append(
            f"| {row['level']} | {row['bytes']:,} | {row['share']:.0%} | {row['anchors']:,} | {row['psnr']:.2f} | "
            f"{row['ssim']:.4f} |"
        )
    more = results["bytes"] - results["undivided_bytes"]
    lines += [
        "",
        f"The same content in one range: {results['undivided_bytes']:,} bytes. The division into "
        f"{len(results['rows'])} ranges costs {more:,} bytes, {more / results['bytes']:.2%} of the file.",
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path)
    parser.add_argument("scene", type=Path)
    parser.add_argument("-r", "--downscale", type=int, default=1)
    parser.add_argument("-o", "--output", type=Path, help="stem of a .md and a .json")
    options = parser.parse_args()
    results = measure(options.file, options.scene, options.downscale)
    text = report(
        results, f"python benchmarks/prefix.py {options.file} {options.scene} -r {options.downscale}"
    )
    print(text)
    if options.output:
        write_bytes(options.output.with_suffix(".md"), text.encode())
        write_json(options.output.with_suffix(".json"), results)


if __name__ == "__main__":
    main()
