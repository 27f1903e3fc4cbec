"""What integer networks and stored weights cost, on a trained run: bits, bytes and decibels.

    python benchmarks/precision.py RUN SCENE [-r DOWNSCALE]

RUN is the folder of a finished `compgs train`. Entropy networks: bits of all streams with the networks as the decoder
evaluates them (weights of that many bits, everything rounded to fixed point) against the same networks in floats.
Prediction heads: PSNR of the held-out views and bytes of the file by the bits of their weights. The trained weights
are only rounded, not trained again: training goes through the rounding of the run's own settings.
"""

import argparse
from dataclasses import replace

import torch

import compgs
from compgs.codec.encoder import to_content
from compgs.codec.writer import write_content
from compgs.metrics import psnr, to_8bit
from compgs.model import HybridModel
from compgs.scene import Scene
from compgs.trained_model import TrainedModel
from compgs.training import load_run


def quality(model: HybridModel, scene: Scene) -> float:
    views = scene.test_views
    return sum(psnr(to_8bit(compgs.render(model, v.camera).image), v.image) for v in views) / len(views)


def with_bits(model: TrainedModel, *, network_bits: int, head_bits: int) -> TrainedModel:
    model.config = replace(model.config, entropy=replace(model.config.entropy, network_bits=network_bits))
    model.head_bits = head_bits
    return model


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run")
    parser.add_argument("scene")
    parser.add_argument("-r", type=int, default=1)
    arguments = parser.parse_args()
    scene = compgs.load_scene(arguments.scene, downscale=arguments.r)
    model = load_run(arguments.run)
    network_bits, trained = model.config.entropy.network_bits, model.head_bits

    rows = torch.nonzero(model.mask.any(1)).view(-1)
    exact = model.quantized(rows, rate=True, stored_weights=False, mask=model.mask[rows]).bits
    floats = sum(float(b.sum(dtype=torch.float64)) for b in exact.values())
    print("| entropy networks | bits of all streams | against floats | file, bytes | PSNR, dB |")
    print("|---|---|---|---|---|")
    print(
        f"| floats | {floats:.0f} | | | {quality(model.as_hybrid_model(stored_weights=False), scene):.3f} |"
    )
    for bits in (16, 14, 13, 12, 10, 8):
        with_bits(model, network_bits=bits, head_bits=trained)
        total = sum(model.estimated_bits().values())
        size = len(write_content(to_content(model)))
        found = quality(model.as_hybrid_model(), scene)
        mark = " (trained with)" if bits == network_bits else ""
        print(
            f"| {bits} bits{mark} | {total:.0f} | {100 * (total / floats - 1):+.3f} % | {size} | {found:.3f} |"
        )
    print("\n| prediction heads | file, bytes | PSNR, dB |\n|---|---|---|")
    for bits in (16, 12, 10, 8, 7, 6):
        with_bits(model, network_bits=network_bits, head_bits=bits)
        size = len(write_content(to_content(model)))
        mark = " (trained with)" if bits == trained else ""
        print(f"| {bits} bits{mark} | {size} | {quality(model.as_hybrid_model(), scene):.3f} |")


if __name__ == "__main__":
    main()
