"""Arithmetic that several rooms share, and the compiling, keeping and running of kernels.

| file | does |
|---|---|
| `compiled` | `njit`, as every kernel of the package uses it |
| `kernel_cache` | keeps compiled kernels between processes |
| `ahead`, `compiling` | compile kernels side by side, and say that some is being compiled |
| `threads` | divides a kernel's work among threads |
| `products`, `vector_sums` | small matrix products and sums, in kernels |
| `ssim` | structural similarity with its gradient, on the CPU |
| `rotations`, `nearest`, `evenly` | quaternions, nearest neighbours, and a few of many, evenly spread |
| `freed_memory` | keeps memory that was freed, or gives it back to the system |
"""
