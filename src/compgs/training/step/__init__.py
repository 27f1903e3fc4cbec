"""One step of a hybrid training, from the views that are looked at to the gradients.

| file | holds |
|---|---|
| `views_in_turn` | which views come next, and their photographs |
| `step_views` | the anchors that a step's views may show, and its noise |
| `dropout` | primitives that a step does without |
| `exposures` | affine changes of color, one for each photograph |
"""
