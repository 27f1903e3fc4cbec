"""Where tensors are computed: by the CPU's kernels, by plain torch, or on a GPU. Asked here, and nowhere else.

Tests replace these answers, to run the GPU's path on a machine without one.
"""

import torch
from torch import Tensor


def in_kernels(*tensors: Tensor) -> bool:
    """Whether the kernels compute with these tensors: they are on the CPU, in float32."""
    return all(tensor.device.type == "cpu" and tensor.dtype == torch.float32 for tensor in tensors)


def runs_in_kernels(device: torch.device, *dtypes: torch.dtype) -> bool:
    """Whether the kernels compute with tensors of these types on a device: on the CPU, in float32."""
    return device.type == "cpu" and all(dtype == torch.float32 for dtype in dtypes)


def on_gpu(tensor: Tensor) -> bool:
    """Whether a tensor is drawn by gsplat."""
    return tensor.is_cuda


def choosing_pays(device: torch.device) -> bool:
    """Whether to leave out primitives that are not drawn: not where their number must first come from a GPU."""
    return device.type != "cuda"
