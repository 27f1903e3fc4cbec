"""Files of Compact 3D Gaussian Representation (Lee et al., CVPR 2024): color from a hash grid."""

# What a file may ask for: levels of the grid, numbers of an entry, cells an axis, log2 of the entries of a level.
MOST_LEVELS, MOST_FEATURES, MOST_CELLS, MOST_TABLE_BITS = 32, 8, 1 << 14, 24
