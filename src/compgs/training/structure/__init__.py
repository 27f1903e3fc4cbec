"""What changes the model between steps.

| file | does |
|---|---|
| `events` | says after which steps something is due, and does it |
| `control` | grows anchors where the image's gradient is large, and removes transparent ones |
| `variants` | how control counts: as here, as published, as in Scaffold-GS |
| `pruning` | removes anchors that are not worth their bits |
| `importance` | measures what primitives add to the training views |
| `decorrelation` | turns references into their principal axes, and drops silent channels |
| `averaging` | takes the mean of the last steps |
"""
