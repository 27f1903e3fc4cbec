"""What the readable prediction, its kernels and the files share of Sec. 3.2 (docs/bitstream_prediction.md)."""

VIEW_DIM = 4  # view embedding: unit direction (3) and distance (1)
# Name, in a file, of the residual embeddings [K, residual_dim] that all anchors share where none has its own.
SHARED_RESIDUALS = "residuals"
# Slope of the leaky ReLU below zero: a power of two, as in the entropy networks.
NEGATIVE_SLOPE = 2.0**-6
# Opacity that a primitive must exceed to be drawn: a splat below it touches no pixel in any rasterizer.
OPACITY_CUTOFF = 1.0 / 255.0
# World units: a camera nearer than this to an anchor sees it from no direction.
SMALLEST_DISTANCE = 1e-12
# Beyond so many standard deviations nothing is drawn: an opaque splat falls below 1/255 at sqrt(2 ln 255) = 3.33.
CUTOFF_SIGMAS = 3.34
