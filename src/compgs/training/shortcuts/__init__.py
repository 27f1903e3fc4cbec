"""What saves time in a step, and is to change nothing else. A run's plan says which of these it takes, and where.

| file | saves |
|---|---|
| `coarse` | pixels: large photographs are halved until details are due |
| `hidden` | anchors: those that stood behind others when a view last looked are passed over |

Two more live where they are computed: the rate in every `rate_every`-th step (`trainer`) and sampled gradients
(`compgs.tensors.gradient_sampling`).
"""
