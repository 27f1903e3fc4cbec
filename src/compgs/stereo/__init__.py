"""Dense points from photographs whose poses are known: where structure from motion found few, anchors would be missing.

| file | idea |
|---|---|
| `looks` | photographs as they are compared: small, gray, with the pose of each |
| `neighbours` | which photographs a photograph is compared with |
| `plane_sweep` | the distance at which a pixel looks alike in its neighbours |
| `fusion` | what several photographs agree on; one point for each cell that looks equally large |
| `dense_points` | all of it, from a scene to the points that are added |
"""

from compgs.stereo.dense_points import dense_points, expected_points

__all__ = ["dense_points", "expected_points"]
