"""Prediction and rendering on torch tensors: with gradients, in any precision, on any device.

`model` and `render` have the same on numpy arrays, for scenes that are looked at and no longer trained; they are all
that decoding, rendering on a CPU and exporting load. Whatever computes with torch beside training is in this room.
"""
