"""Arithmetic that several rooms share: linear layers, sums, SSIM, rotations."""
