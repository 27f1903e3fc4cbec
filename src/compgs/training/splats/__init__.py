"""Training of plain 3D Gaussian Splatting, and of the methods that compress it.

| file | holds |
|---|---|
| `trainer` | the state of a run, and its step |
| `phases` | runs of several phases, one after the other |
| `hooks` | what a method changes in a step |
| `parameters` | splats as parameters, and their optimizer |
| `densification` | cloning, splitting, pruning, and the reset of opacities |
"""
