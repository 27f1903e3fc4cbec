"""Anchors that spawn Gaussians by view-dependent networks (Scaffold-GS; Lu et al., CVPR 2024): what methods share.

    anchor: feature, K offsets, position scale, size            (one or three position scales)
    [feature, direction, distance] ─► opacity, color, scale and rotation of all K at once

    mean_k = anchor + exp(position scale) offset_k      opacity_k = tanh > 0      color_k = sigmoid
    scales_k = exp(size) sigmoid      quaternion_k

`prediction` has the equations with gradients, `scene` the same on numpy arrays, `model` what is trained, `trainer` how.
Settings: `model.coupled_primitives` is K, `model.reference_dim` the channels of a feature, `model.width` the hidden
channels of the networks; voxels, control, losses and learning rates are those of `compgs.config`, too.
"""
