"""LPIPS, the learned perceptual distance (Zhang et al. 2018): version 0.1, on VGG16.

Weights are read with NumPy (`weights.py`); the network is torch (`network.py`). Neither needs anything else, so both
work where only a file with the weights was carried along.
"""

from compgs.lpips.network import LpipsDistances, LpipsNetwork, lpips_network
from compgs.lpips.weights import LpipsWeights, find_weights, read_weights, write_weights

__all__ = [
    "LpipsDistances",
    "LpipsNetwork",
    "LpipsWeights",
    "find_weights",
    "lpips_network",
    "read_weights",
    "write_weights",
]
